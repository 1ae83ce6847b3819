"""Locomotion modes: reference motions, mode sets, schedules, latents.

`library` has the modes that ship, `files` reads those of users, and `encoder`,
which alone needs torch, trains latents.
"""

from dmc_multimode.modes.codebook import Codebook
from dmc_multimode.modes.mode_set import ModeSet
from dmc_multimode.modes.motion import Ledge
from dmc_multimode.modes.motion import ReferenceMotion
from dmc_multimode.modes.reference import Reference
from dmc_multimode.modes.reference import ReferenceBank
from dmc_multimode.modes.schedule import ModeSchedule

__all__ = (
  'Codebook',
  'Ledge',
  'ModeSchedule',
  'ModeSet',
  'Reference',
  'ReferenceBank',
  'ReferenceMotion',
)
