"""The imitation task: rough references, Eq. 3, two engines over one core."""

__all__ = [
  'batched_env',
  'commands',
  'composer_task',
  'config',
  'core',
  'episodes',
  'events',
  'mode_sampler',
  'mujoco_worlds',
  'observations',
  'obstacles',
  'resets',
  'rewards',
  'symmetry',
  'terminations',
  'terrain_events',
]
