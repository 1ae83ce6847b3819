"""Trains the quick start from Python, and films what it has learned.

    python examples/train_from_python.py

Six million environment steps take ten minutes on two cores. Settings are named
as the flags of `train` are; Ctrl-C stops with a checkpoint, and `resume=True`
goes on from there.
"""

import dmc_multimode as dmm


def main(folder: str = 'runs/example', steps: int = 6_000_000) -> None:
  """Trains, evaluates, films."""
  policy = dmm.train(
    folder,
    modes='quickstart',
    steps=steps,
    sampling_gait_fraction='0.85:0@500000:1500000',  # Gaits first.
    sampling_clock_rates=(1.0, 1.0),
    task_events_contact_bonus='1:0.3@2000000:3500000',
    ppo_std_floor='0.17:0.05@2500000:5500000',  # Less and less noise.
  )
  report = dmm.evaluate(policy, seed=0)
  print(f'MRA over the modes {report["mra_modes"]["mean"]:.3f}')
  dmm.record(
    policy,
    schedule='idle:1,walk_forward:2.4,leap_forward:2.4',
    out=f'{folder}/film.mp4',
  )


if __name__ == '__main__':
  main()
