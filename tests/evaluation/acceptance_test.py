"""Tests of dmc_multimode.evaluation.acceptance."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial import transform

from dmc_multimode.evaluation import acceptance
from dmc_multimode.evaluation import gait_metrics
from dmc_multimode.modes import library
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import reference
from dmc_multimode.utils import constants

_TIMESTEP = 0.03  # Seconds.
_MODES = library.modes()


def _perfect(motion: motion_lib.ReferenceMotion) -> gait_metrics.Trace:
  """Returns the trace of a body that follows the reference exactly."""
  steps = round(acceptance.DURATION / _TIMESTEP)
  turns, phases = np.divmod(_TIMESTEP * np.arange(steps) / motion.duration, 1.0)
  if motion.kind == motion_lib.TRANSIENT:
    turns, phases = 0 * turns, np.where(turns > 0, 1.0, phases)
  sample = reference.sample(motion, phases)
  moved = motion.positions[-1] - motion.positions[0]
  position = sample.position + turns[:, None] * moved
  turn = reference.ReferenceBank([motion]).turns[0]
  support = np.zeros(steps)
  if motion.ledge is not None:
    support[position[:, 0] > motion.ledge.edge] = motion.ledge.height
  return gait_metrics.Trace(
    position,
    position,
    support,
    motion_lib.yaw(sample.orientation) + turns * turn,
    motion_lib.tilt(sample.orientation),
    sample.contact,
    sample.contact,
    _TIMESTEP,
    motion.duration,
  )


def _findings(
  motion: motion_lib.ReferenceMotion, *traces: gait_metrics.Trace
) -> dict[str, acceptance.Finding]:
  return {v.metric: v for v in acceptance.check(motion, traces)}


@pytest.mark.parametrize(
  ('name', 'expected'),
  [
    ('idle', {'drift': (-np.inf, 0.05)}),
    (
      'walk_forward',
      {
        'speed': (0.5, 0.7),
        'bob': (-np.inf, 0.05),
        'alternation': (0.8, np.inf),
      },
    ),
    ('leap_forward', {'rise': (0.15, np.inf), 'flight': (0.1512, np.inf)}),
    ('hop_forward', {'flight': (0.09, np.inf)}),
    ('launch', {'stance': (1.0, np.inf)}),
  ],
)
def test_criteria(name: str, expected: dict[str, tuple[float, float]]) -> None:
  found = {
    criterion.metric: (criterion.least, criterion.most)
    for criterion in acceptance.criteria(_MODES[name])
  }
  assert found.keys() == expected.keys()
  for metric, bounds in expected.items():
    assert found[metric] == pytest.approx(bounds)


@pytest.mark.parametrize('name', _MODES)
def test_a_perfect_body_passes_all(name: str) -> None:
  motion = _MODES[name]
  findings = _findings(motion, _perfect(motion))
  assert findings and all(v.passed for v in findings.values()), findings
  json.dumps([v.passed for v in findings.values()])  # As a report has it.


@pytest.mark.parametrize('name', ['idle', 'walk_forward', 'launch'])
def test_bounds_grow_with_the_robot(name: str) -> None:
  size = 0.5
  motion = motion_lib.scaled(_MODES[name], size * constants.STAND_HEIGHT)
  found = acceptance.check(motion, [_perfect(motion)], size)
  assert found and all(finding.passed for finding in found)
  bounds = {
    small.metric: (small.most, large.most)
    for small, large in zip(
      acceptance.criteria(motion, size),
      acceptance.criteria(_MODES[name]),
      strict=True,
    )
  }
  for metric in bounds.keys() & {'drift', 'bob'}:
    assert bounds[metric][0] == size * bounds[metric][1]


@pytest.mark.parametrize('name', _MODES)
def test_a_body_that_stands_fails_all_that_ask_to_move(name: str) -> None:
  motion = _MODES[name]
  perfect = _perfect(motion)
  still = np.zeros_like(perfect.position)
  still[:, 2] = 0.5
  trace = perfect._replace(
    position=still,
    support=np.zeros(len(still)),
    yaw=np.zeros(len(still)),
    contact=np.ones_like(perfect.contact),
  )
  failed = {m for m, v in _findings(motion, trace).items() if not v.passed}
  held = {'drift', 'bob'}
  assert failed == {p.metric for p in acceptance.criteria(motion)} - held


def test_mean_decides_and_the_worst_is_named() -> None:
  motion = _MODES['idle']
  perfect = _perfect(motion)
  traces = []
  for way in (0.01, 0.08, 0.03):
    position = perfect.position.copy()
    position[50:, 1] += way
    traces.append(perfect._replace(position=position))
  finding = _findings(motion, *traces)['drift']
  assert finding.value == pytest.approx(0.04)
  assert finding.worst == pytest.approx(0.08)
  assert finding.passed


def test_a_squat_rises() -> None:
  """On the spot, both feet on the ground."""
  motion = dataclasses.replace(
    _MODES['idle'],
    kind=motion_lib.PERIODIC,
    duration=1.2,
    phases=np.array([0.0, 0.5, 1.0]),
    positions=np.array([[0, 0, 0.5], [0, 0, 0.4], [0, 0, 0.5]]),
    orientations=np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
    contacts=np.ones((3, 2)),
  )
  finding = _findings(motion, _perfect(motion))['rise']
  assert finding.least == pytest.approx(0.06)
  assert finding.value == pytest.approx(0.1, abs=0.01) and finding.passed
  standing = _perfect(_MODES['idle'])._replace(cycle=1.2)
  found = _findings(motion, standing)
  assert list(found) == ['rise'] and not found['rise'].passed


def test_gaits_of_four_feet_that_step_in_turns_alternate() -> None:
  known = library.four_footed_modes()
  alternating = {
    name: 'alternation' in [c.metric for c in acceptance.criteria(motion)]
    for name, motion in known.items()
    if name.split('_')[0] in ('trot', 'pace', 'bound', 'pronk')
  }
  assert alternating == {
    'trot_forward': True,
    'pace_forward': True,
    'bound_forward': False,
    'pronk_forward': False,
  }


def test_modes_of_which_little_is_known_have_few_criteria() -> None:
  walk = dataclasses.replace(_MODES['walk_forward'], contacts=None)
  assert [p.metric for p in acceptance.criteria(walk)] == ['speed', 'bob']
  jump = dataclasses.replace(_MODES['launch'], ledge=None)
  assert acceptance.criteria(jump) == ()


def _leaning(
  kind: str, *angles: tuple[float, float]
) -> motion_lib.ReferenceMotion:
  """Returns a motion on the spot through (roll, pitch), degrees, in 1.2 s."""
  return motion_lib.ReferenceMotion(
    name='lean',
    kind=kind,
    duration=1.2,
    phases=np.linspace(0.0, 1.0, len(angles)),
    positions=np.tile([0.0, 0.0, 0.5], (len(angles), 1)),
    orientations=transform.Rotation.from_euler(
      'xy', angles, degrees=True
    ).as_quat(scalar_first=True),
  )


@pytest.mark.parametrize(
  ('motion', 'least'),
  [
    # A bow, once; the trunk is upright again for most of the episode.
    (_leaning('transient', (0, 0), (0, 30), (0, 0)), {'lean_ahead': 15}),
    (_leaning('steady', (0, -20), (0, -20)), {'lean_back': 10}),
    (
      _leaning('periodic', (0, 0), (20, 0), (0, 0), (-12, 0), (0, 0)),
      {'lean_right': 10, 'lean_left': 6},
    ),
    (_leaning('periodic', (0, 0), (5, -5), (0, 0)), {}),
  ],
)
def test_a_trunk_that_leans_in_the_reference_has_to_lean(
  motion: motion_lib.ReferenceMotion, least: dict[str, float]
) -> None:
  trace = _perfect(motion)
  found = _findings(motion, trace)
  leans = {key: found[key] for key in found if key.startswith('lean')}
  assert {key: np.rad2deg(leans[key].least) for key in leans} == (
    pytest.approx(least)
  )
  for finding in leans.values():
    # Steps of 0.03 s may miss the extreme keyframe by 3 degrees.
    reached = np.rad2deg(finding.value)
    assert finding.passed
    assert -1e-9 <= 2 * np.rad2deg(finding.least) - reached < 3
  upright = _findings(motion, trace._replace(tilt=0.4 * trace.tilt))
  assert not any(upright[name].passed for name in leans)
  other = _findings(motion, trace._replace(tilt=-trace.tilt))
  assert len(leans) != 1 or not any(other[name].passed for name in leans)


def test_no_mode_of_the_library_leans() -> None:
  for motion in {**library.modes(), **library.four_footed_modes()}.values():
    names = {criterion.metric for criterion in acceptance.criteria(motion)}
    assert not any(name.startswith('lean') for name in names), motion.name
