"""The robots: declarations and MJCF models as dm_control walkers."""

from dmc_multimode.utils import gl

# Before modules of it import dm_control, which looks for a display.
gl.choose_late_without_display()

__all__ = [
  'derivation',
  'kinematics',
  'mini_biped',
  'mirroring',
  'robot',
  'robot_files',
  'robot_walker',
]
