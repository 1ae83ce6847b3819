"""Blends of two modes in steps of a tenth, all made beforehand.

A task keeps the modes that it was made with: so that a slider may command any
blend at once, its task has all of them.
"""

import itertools

from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.planner import plan as plan_lib

STEP = 0.1  # Between the shares of a mode.


class Blends:
  """Blends of the modes of a policy.

  Attributes:
    mode_set: the policy's modes, and the blends behind them.
    rest: name of the mode of rest.
    pairs: names of the modes that can be blended.
  """

  def __init__(self, mode_set: mode_set_lib.ModeSet):
    """Makes every blend of two modes that there can be."""
    rest = mode_set.names[plan_lib.rest_mode(mode_set)]
    # Rest is last: 'walk_forward*0.5+idle*0.5' is walking at half its speed.
    ordered = sorted(mode_set.names, key=lambda name: name == rest)
    self.rest = rest
    self.pairs = tuple(
      pair
      for pair in itertools.combinations(ordered, 2)
      if _is_blendable(mode_set, *pair)
    )
    self._names = {
      (*pair, tenths): _name(*pair, tenths)
      for pair in self.pairs
      for tenths in range(1, 10)
    }
    self._main = {
      name: first if second == rest or tenths <= 5 else second
      for (first, second, tenths), name in self._names.items()
    }
    self.mode_set = mode_set_lib.with_blends(mode_set, [*self._main])

  def find(self, first: str, second: str, share: float) -> str | None:
    """Returns the name of a blend, or of a mode alone.

    Args:
      first, second: names of modes.
      share: of the second, one of 0, 0.1, ... 1.

    Returns:
      None if the two cannot be blended.

    Raises:
      ValueError: the share is another.
    """
    tenths = round(share / STEP)
    if not (0 <= tenths <= 10 and abs(tenths - share / STEP) < 1e-6):
      raise ValueError(f'A share is one of 0, 0.1, ... 1, got {share}.')
    if (second, first) in self.pairs:
      first, second, tenths = second, first, 10 - tenths
    if (first, second) not in self.pairs:
      return None
    if tenths in (0, 10):
      return second if tenths else first
    return self._names[first, second, tenths]

  def slower(self, gait: str, speed: float) -> str | None:
    """Returns a gait at a share of its speed: a blend with rest.

    Args:
      gait: name of a mode.
      speed: share of its speed, one of 0.1, 0.2, ... 1.

    Returns:
      None if the mode is no gait on the ground, or there is no mode of rest.
    """
    bank = self.mode_set.bank
    is_gait = bank.level[self.mode_set.index(gait)]
    if is_gait and bank.steady[self.mode_set.index(self.rest)]:
      return self.find(gait, self.rest, 1 - speed)
    return None

  def main(self, name: str) -> str:
    """Returns the mode that a blend is most of: of gait and rest, the gait."""
    return self._main.get(name, name)


def _name(first: str, second: str, tenths: int) -> str:
  share = round(STEP * tenths, 1)
  return f'{first}*{1 - share:g}+{second}*{share:g}'


def _is_blendable(
  mode_set: mode_set_lib.ModeSet, first: str, second: str
) -> bool:
  """Returns whether a blend of the two modes is a motion."""
  try:
    mode_set_lib.with_blends(mode_set, [_name(first, second, 5)])
  except ValueError:
    return False
  return True
