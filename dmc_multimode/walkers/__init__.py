"""The robots: declarations and MJCF models as dm_control walkers."""

__all__ = [
  'derivation',
  'kinematics',
  'mini_biped',
  'mirroring',
  'robot',
  'robot_files',
  'robot_walker',
]
