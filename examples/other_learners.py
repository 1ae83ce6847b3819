"""Trains by Stable-Baselines3 and by rsl_rl on this package's worlds.

    pip install 'dmc_multimode[sb3,rsl_rl]'
    python examples/other_learners.py

The adapters need no settings; those here are short ones of each library.
"""

from rsl_rl import runners
import stable_baselines3

import dmc_multimode as dmm
from dmc_multimode.suite.wrappers import rsl_rl_env
from dmc_multimode.suite.wrappers import stable_baselines3_env

_NETWORK = {
  'class_name': 'MLPModel',
  'hidden_dims': [256, 128],
  'activation': 'elu',
  'obs_normalization': True,
}
_SETTINGS = {
  'num_steps_per_env': 24,
  'obs_groups': {'actor': ['policy'], 'critic': ['policy', 'privileged']},
  'actor': {
    **_NETWORK,
    'distribution_cfg': {'class_name': 'GaussianDistribution', 'init_std': 0.2},
  },
  'critic': _NETWORK,
  'algorithm': {
    'class_name': 'PPO',
    'schedule': 'adaptive',
    'desired_kl': 0.01,
  },
}


def main(steps: int = 1_000_000, num_worlds: int = 512) -> None:
  """Trains a walk twice."""
  worlds = dmm.make_worlds('walk_forward', num_worlds)
  model = stable_baselines3.PPO(
    'MlpPolicy',
    stable_baselines3_env.StableBaselines3VecEnv(worlds),
    n_steps=24,
    batch_size=num_worlds * 6,
    device='cpu',
    verbose=1,
  )
  model.learn(steps)
  worlds = dmm.make_worlds('walk_forward', num_worlds, privileged=True)
  runner = runners.OnPolicyRunner(
    rsl_rl_env.RslRlVecEnv(worlds), _SETTINGS, device='cpu'
  )
  runner.learn(max(steps // (24 * num_worlds), 1))


if __name__ == '__main__':
  main()
