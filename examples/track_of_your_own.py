"""Declares a track, plans a way across it, and films the plan.

    python examples/track_of_your_own.py

A track is a sequence of pieces: length, height over the start, and the gap
before each, metres.
"""

import pathlib

import dmc_multimode as dmm
from dmc_multimode.arenas import layouts


def two_gaps(width: float = 0.3) -> tuple[layouts.Piece, ...]:
  """Returns two gaps with half a metre between them."""
  return (
    layouts.Piece(0.7),
    layouts.Piece(0.5, gap=width),
    layouts.Piece(20.0, gap=width),
  )


def main(folder: str = 'out', width: float = 0.3) -> None:
  """Plans, prints, films."""
  layouts.register('two_gaps', two_gaps)
  out = pathlib.Path(folder)
  out.mkdir(parents=True, exist_ok=True)
  found = dmm.plan('pi2', arena='two_gaps', sizes={'width': width})
  for mode, seconds in zip(*found.plan.segments(), strict=True):
    print(f'{mode} for {seconds:.2f} s')
  print('stands at the goal' if found.success else 'did not get there')
  found.save(out / 'two_gaps.json')
  dmm.record('pi2', plan=out / 'two_gaps.json', out=out / 'two_gaps.mp4')


if __name__ == '__main__':
  main()
