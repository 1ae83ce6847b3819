"""Adds a mode of your own, a squat, to a trained policy.

    python examples/mode_of_your_own.py

A mode is a few keyframes of the trunk and the contacts of the feet. The policy
keeps the modes that it has; five minutes on two cores teach it the new one.
"""

import numpy as np

import dmc_multimode as dmm
from dmc_multimode.modes import motion


def squat(depth: float = 0.13) -> motion.ReferenceMotion:
  """Returns a mode that lets the trunk down by `depth` metres, and up again."""
  heights = [0.5, 0.5 - depth, 0.5 - depth, 0.5]
  return motion.ReferenceMotion(
    name='squat',
    kind=motion.PERIODIC,
    duration=1.2,  # Seconds.
    phases=np.array([0.0, 0.4, 0.6, 1.0]),
    positions=np.array([[0.0, 0.0, height] for height in heights]),
    orientations=np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)),
    contacts=np.ones((4, 2)),
  )


def main(
  folder: str = 'runs/squat', policy: str = 'pi2', steps: int = 4_000_000
) -> None:
  """Fine-tunes, evaluates, films."""
  names = dmm.load_policy(policy).mode_set.names
  tuned = dmm.train(
    folder, modes=[*names, squat()], init_from=policy, steps=steps
  )
  report = dmm.evaluate(tuned, seed=0, episodes=2)
  for name, mode in report['modes'].items():
    print(f'{name:16}{mode["mra"]:.3f}')
  dmm.record(tuned, schedule='idle:1,squat:3.6', out=f'{folder}/squat.mp4')


if __name__ == '__main__':
  main()
