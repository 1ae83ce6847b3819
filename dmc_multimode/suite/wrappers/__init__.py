"""The suite behind the interfaces of other libraries; each needs its extra."""

__all__ = [
  'gymnasium_env',
  'gymnasium_vector_env',
  'rsl_rl_env',
  'stable_baselines3_env',
]
