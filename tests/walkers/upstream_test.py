"""dm_control's own tests of walkers, run on the mini biped and on tracks.

The cases come from the installed package; in each, names of its walkers and
arenas stand for ours.
"""

import fnmatch
from typing import Any, Callable, Iterator
import unittest

from dm_control.locomotion.soccer import task_test as soccer_task_test
from dm_control.locomotion.tasks import corridors_test
from dm_control.locomotion.tasks import go_to_target_test
from dm_control.locomotion.walkers import ant_test
from dm_control.locomotion.walkers import cmu_humanoid_test
from dm_control.locomotion.walkers import jumping_ball_test
from dm_control.locomotion.walkers import rodent_test
import pytest

from dmc_multimode.arenas import track
from dmc_multimode.walkers import mini_biped

_MiniBiped = mini_biped.MiniBiped
_Names = dict[tuple[Any, str], Callable[..., Any]]


def _flat() -> track.Track:
  return track.make('flat')


def _player(name: str, walker_id: int, marker_rgba: Any) -> _MiniBiped:
  del walker_id  # On a box head's shirt.
  return _MiniBiped(name=name, marker_rgba=marker_rgba)


# Of each run: its name, the module of its cases, and what names stand for.
_RUNS: tuple[tuple[str, Any, _Names], ...] = (
  ('biped', ant_test, {(ant_test.ant, 'Ant'): _MiniBiped}),
  (
    'biped',
    jumping_ball_test,
    {(jumping_ball_test.jumping_ball, 'JumpingBallWithHead'): _MiniBiped},
  ),
  ('biped', rodent_test, {(rodent_test.rodent, 'Rat'): _MiniBiped}),
  (
    'biped',
    cmu_humanoid_test,
    {(cmu_humanoid_test.cmu_humanoid, 'CMUHumanoid'): _MiniBiped},
  ),
  (
    'biped_on_track',
    corridors_test,
    {
      (corridors_test.cmu_humanoid, 'CMUHumanoid'): _MiniBiped,
      (corridors_test.corridor_arenas, 'EmptyCorridor'): _flat,
    },
  ),
  (
    'humanoid_on_track',
    corridors_test,
    {(corridors_test.corridor_arenas, 'EmptyCorridor'): _flat},
  ),
  (
    'biped_on_track',
    go_to_target_test,
    {
      (go_to_target_test.cmu_humanoid, 'CMUHumanoid'): _MiniBiped,
      (go_to_target_test.floors, 'Floor'): _flat,
    },
  ),
  (
    'humanoid_on_track',
    go_to_target_test,
    {(go_to_target_test.floors, 'Floor'): _flat},
  ),
  ('biped', soccer_task_test, {(soccer_task_test.soccer, 'BoxHead'): _player}),
)

# Pattern of cases that cannot apply -> the reason.
_OTHERS: dict[str, str] = {
  "*.test_evaluate_observable*('*_pos')": "other walkers' observables",
  "*.test_evaluate_observable*('tendons_*')": 'it has no tendons',
  "*.test_evaluate_observable*('actuator_activation')": 'servos have no state',
  "*.test_evaluate_observable*('head_height')": 'it has no head',
  "*.test_evaluate_observable*('body_camera')": 'no such camera',
  "*.test_get_element_property*('*head')": 'it has no head',
  "*.test_get_element_property*('*_arm_root')": 'it has no arms',
  "*.test_get_element_property*('pelvis_body')": 'the trunk is one body',
  "*.test_get_element_property*('body_camera')": 'no such camera',
  '*.JumpingBallWithHeadTest.test_instantiation*': 'arguments of the ball',
  '*.CMUHumanoidTest.test_can_compile*': 'the case names its walkers itself',
  '*.CMUHumanoidTest.test_actuators_sorted*': 'ours are in the order of JOINTS',
  '*.CMUHumanoidTest.test_actuator_to_mocap*': 'it has no motion capture',
  '*.CMUHumanoidTest.test_cmu_*': 'of the humanoid with position control',
  '*.TaskTest.test_step_environment*': "it counts the box head's observables",
  '*.TaskTest.test_num_players*': "it counts the box head's observables",
  '*.TaskTest.test_scoring*': 'of the game, not of its players',
  '*.TaskTest.test_t[eh]*': 'of the game, not of its players',
  '*.TaskTest.test_render*': 'of the game, not of its players',
  '*.UniformInitializerTest.test_ball*': 'of the game, not of its players',
  '*.MultiturnTaskTest.*': 'of the game, not of its players',
  'biped_*.CorridorsTest.test_walker_is*180*True*': 'it wants 6e-17 to be 0',
  # It has the walker 10 m in the air, or in the ground: hard soles bounce off.
  'biped_on_track.*.test_termination_and_discount*': 'it bounces back',
  'biped.TaskTest.test_symmetric_observations*': '3000 m/s^2 to 1e-6',
}

# Of modules whose robots have an egocentric camera.
_DRAWING = (ant_test, corridors_test, jumping_ball_test, rodent_test)


def _cases() -> Iterator[Any]:
  """Yields the cases with the names to replace, as pytest's parameters."""
  loader: Any = unittest.TestLoader()
  for run, module, names in _RUNS:
    for suite in loader.loadTestsFromModule(module):
      for case in suite:
        name = case._testMethodName
        arguments = getattr(case, '_test_params_reprs', {}).get(name, '')
        label = f'{run}.{type(case).__name__}.{name}{arguments}'
        reason = _reason(label)
        marks = [pytest.mark.gl] if module in _DRAWING else []
        marks += [pytest.mark.skip(reason)] if reason else []
        yield pytest.param(case, names, id=label, marks=marks)


def _reason(label: str) -> str:
  matches = (r for p, r in _OTHERS.items() if fnmatch.fnmatchcase(label, p))
  return next(matches, '')


@pytest.mark.parametrize(('case', 'names'), list(_cases()))
def test_upstream(
  case: unittest.TestCase, names: _Names, monkeypatch: pytest.MonkeyPatch
) -> None:
  for (module, name), ours in names.items():
    monkeypatch.setattr(module, name, ours)
  case.debug()
