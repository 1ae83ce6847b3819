"""Evaluates a policy on slippery ground, and prints which mode suffers most.

    python examples/evaluate_on_ice.py

`disturbed` takes every disturbance of `evaluate`: delays, payloads, weak
motors, slopes, noise, pushes.
"""

import dmc_multimode as dmm


def main(policy: str = 'pi2', episodes: int = 4) -> None:
  """Compares friction 0.9, the nominal one, with 0.4."""
  reports = {
    friction: dmm.evaluate(
      policy, seed=0, episodes=episodes, disturbed={'friction': friction}
    )
    for friction in (0.9, 0.4)
  }
  usual, slippery = (report['modes'] for report in reports.values())
  print(f'{"mode":16}{"friction 0.9":>14}{"0.4":>8}{"survival":>10}')
  for name, mode in usual.items():
    other = slippery[name]
    print(
      f'{name:16}{mode["mra"]:14.3f}{other["mra"]:8.3f}'
      f'{other["survival"]:10.2f}'
    )


if __name__ == '__main__':
  main()
