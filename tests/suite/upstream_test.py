"""Test suites and checkers of others, as installed, over what is registered.

What cannot apply is in `_SKIPPED`, with the reason.
"""

import importlib
from typing import Any
from unittest import mock
import warnings

from dm_control import suite as dm_suite
import pytest

from dmc_multimode import suite

_TASKS = [task for _, task in suite.ALL_TASKS]
# One of each kind for dm_control's tests, which load a task 6 times; all have
# the contract of `suite_test`.
_KINDS = tuple(
  (suite.DOMAIN, task)
  for task in ('idle', 'launch', 'pi_all', 'reach_gap', 'reach_parkour')
)
_FEW = ('walk_forward', 'pi2', 'reach_gap')
_SKIPPED = {
  'test_task_supports_environment_kwargs': (
    'flat_observation is of dm_control.rl; Composer environments have none.'
  ),
  'test_observations_dont_contain_constant_elements': (
    'The command is the same as long as a mode runs.'
  ),
  'test_visualize_reward': (
    "Ours colour the eye and are tagged no_reward_visualization; dm_control's "
    'materials are self, effector and target.'
  ),
}
# Joint targets are in radians and what robots do has no bounds: both advised
# against, and meant.
_EXPECTED_WARNINGS = (
  'Box observation space minimum value is -infinity',
  'Box observation space maximum value is infinity',
  'we recommend using a symmetric and normalized',
  'recommend you to use a symmetric and normalized Box action space',
)

pytest.importorskip('mock', reason="dm_control's suite_test needs it.")
# Its parameters are the tasks that there are as it is imported.
with mock.patch.multiple(dm_suite, ALL_TASKS=_KINDS, REWARD_VIZ=_KINDS[:1]):
  suite_test: Any = importlib.import_module('dm_control.suite.suite_test')


class DmControlSuiteTest(suite_test.SuiteTest):
  """dm_control's tests of its suite, over our tasks."""

  def setUp(self) -> None:
    super().setUp()
    name = self._testMethodName.rstrip('0123456789')
    if name in _SKIPPED:
      self.skipTest(_SKIPPED[name])


def _environment(
  task: str, vector: dict[str, Any] | None = None, **kwargs: Any
) -> Any:
  """Returns a single environment, or two with the arguments for a vector."""
  gymnasium = pytest.importorskip('gymnasium', reason='The extra `gym`.')
  wrapper: Any = importlib.import_module(
    'dmc_multimode.suite.wrappers.gymnasium_env'
  )
  name = wrapper.environment_id(task)
  if vector is None:
    return gymnasium.make(name, **kwargs)
  return gymnasium.make_vec(name, 2, **vector, **kwargs)


def _checked_without_warnings(check: Any, env: Any, library: str) -> None:
  """Passes a check; the library warns of nothing but what is meant."""
  with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter('always')
    check(env)
  env.close()
  assert not [
    str(warning.message)
    for warning in caught
    if library in warning.filename
    and not any(text in str(warning.message) for text in _EXPECTED_WARNINGS)
  ]


@pytest.mark.parametrize('task', _TASKS)
def test_gymnasiums_check(task: str) -> None:
  env = _environment(task).unwrapped
  checker: Any = importlib.import_module('gymnasium.utils.env_checker')
  _checked_without_warnings(
    lambda env: checker.check_env(env, skip_render_check=True), env, 'gymnasium'
  )


@pytest.mark.gl
@pytest.mark.parametrize('task', _FEW[1:])
def test_gymnasiums_check_of_frames(task: str) -> None:
  env = _environment(task, render_mode='rgb_array').unwrapped
  checker: Any = importlib.import_module('gymnasium.utils.env_checker')
  _checked_without_warnings(checker.check_env, env, 'gymnasium')


@pytest.mark.parametrize('task', _FEW)
def test_stable_baselines3s_check(task: str) -> None:
  pytest.importorskip('stable_baselines3', reason='The extra `sb3`.')
  checker: Any = importlib.import_module('stable_baselines3.common.env_checker')
  _checked_without_warnings(
    checker.check_env, _environment(task), 'stable_baselines3'
  )


@pytest.mark.parametrize(
  ('task', 'vector'),
  [
    ('walk_forward', None),
    ('reach_gap', None),
    ('pi2', {'autoreset_mode': 'SameStep'}),
    ('pi2', {'autoreset_mode': 'Disabled'}),
    ('pi2', {'vectorization_mode': 'sync'}),
  ],
)
def test_torchrls_check(task: str, vector: dict[str, Any] | None) -> None:
  envs: Any = pytest.importorskip('torchrl.envs', reason='No TorchRL.')
  if vector and 'vectorization_mode' in vector:
    mode: Any = importlib.import_module('gymnasium.vector').AutoresetMode
    vector['vector_kwargs'] = {'autoreset_mode': mode.SAME_STEP}
  env = envs.GymWrapper(_environment(task, vector, time_limit=0.6))
  envs.check_env_specs(env)
  rollout = env.rollout(30, break_when_any_done=False)
  assert rollout['next', 'done'].any()
