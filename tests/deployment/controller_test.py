"""Tests of dmc_multimode.deployment.controller, without an exported model."""

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np
import pytest

from dmc_multimode import pretrained
from dmc_multimode.arenas import terrain
from dmc_multimode.arenas import track
from dmc_multimode.deployment import description
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import observations

controller_lib = pytest.importorskip(
  'dmc_multimode.deployment.controller',
  reason='a controller takes the extra `export`',
)


class _Session:
  """A policy in the place of its model; keeps what it observed last."""

  def __init__(self, policy: pretrained.Policy):
    self._policy, self.seen = policy, np.zeros((1, 0))

  def run(self, outputs: None, inputs: dict[str, np.ndarray]) -> Any:
    del outputs
    self.seen = inputs['observation']
    # What it was not trained with comes after what it was.
    known = self.seen[:, : self._policy.network.observation_size]
    return (self._policy.select_action(known),)


def _controller(
  policy: pretrained.Policy,
  folder: pathlib.Path,
  monkeypatch: pytest.MonkeyPatch,
) -> tuple[Any, _Session]:
  path = folder / 'policy.onnx'
  about = json.dumps(description.describe(policy))
  path.with_suffix('.json').write_text(about)
  session = _Session(policy)
  runtime = controller_lib.onnxruntime
  monkeypatch.setattr(runtime, 'InferenceSession', lambda path: session)
  return controller_lib.Controller(path), session


def test_it_observes_what_the_task_does_while_it_turns(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  policy = pretrained.load('pi_all')
  config = task_config.evaluated(
    policy.config,
    extra_observations=observations.EXTRA_NAMES,
    feasible_references=True,
    time_limit=6.0,
  )
  policy = dataclasses.replace(policy, config=config)
  names = policy.mode_set.names
  # 0.97 s are no whole cycle: commands come in mid-turn.
  modes = ['idle', 'turn_left', 'walk_forward', 'turn_right', 'idle']
  starts = [0.0, 0.3, 2.17, 3.14, 4.11]
  schedule = schedule_lib.ModeSchedule(
    np.array([[names.index(mode) for mode in modes]]),
    np.array([starts]),
    np.ones(1),
  )
  worlds = batched_env.BatchedImitation(
    multimode_biped.make_task(
      policy.mode_set, episodes.ScheduledEpisodes(schedule), config=config
    ),
    num_worlds=1,
    seed=0,
    num_threads=1,
  )
  expected = worlds.reset()
  controller, session = _controller(policy, tmp_path, monkeypatch)
  scan = observations.part(
    'ground_scan', policy.mode_set.latent_dim, False, config.extra_observations
  )
  headings = []
  for _ in range(150):
    state, place = worlds.core.tracker.state, worlds.qpos[0, :2]
    controller.command(names[state.mode[0]], place, worlds.qvel[0, :2])
    sensed = controller_lib.sense(worlds.qpos[0], worlds.qvel[0], 0.0)
    action = controller.act(place, sensed, expected[0, scan])
    np.testing.assert_allclose(session.seen, expected, atol=1e-5)
    assert controller.heading == pytest.approx(state.heading[0])
    headings.append(controller.heading)
    time_step = worlds.step(action[None])
    assert not time_step.last.any()
    expected = time_step.observation
    controller.advance()
  assert max(headings) > 1.0 and np.ptp(headings[-60:]) > 0.5


def test_a_policy_of_one_mode_that_walks(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  policy = pretrained.load('unimodal_walk')
  controller, session = _controller(policy, tmp_path, monkeypatch)
  assert controller.mode['name'] == 'walk_forward'
  sensed = controller_lib.sense(np.eye(17)[3], np.zeros(16), 0.0)
  assert controller.act(np.zeros(2), sensed).shape == (10,)
  assert session.seen.shape == (1, policy.network.observation_size)
  controller, _ = _controller(pretrained.load('pi2'), tmp_path, monkeypatch)
  assert controller.mode['name'] == 'idle'


def test_a_scan_that_lacks_is_said(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  policy = pretrained.load('unimodal_walk')
  config = dataclasses.replace(
    policy.config, extra_observations=('ground_scan',)
  )
  policy = dataclasses.replace(policy, config=config)
  controller, session = _controller(policy, tmp_path, monkeypatch)
  sensed = controller_lib.sense(np.eye(17)[3], np.zeros(16), 0.0)
  for scan in (None, np.zeros(3)):
    with pytest.raises(ValueError, match='scan=.*16 heights'):
      controller.act(np.zeros(2), sensed, scan)
  scan = np.append(np.linspace(-1, 1, 15), -np.inf)
  controller.act(np.zeros(2), sensed, scan)
  found = session.seen[0, policy.network.observation_size :]
  assert found[0] == found[15] == np.float32(-0.6)
  assert (found[7], found[14]) == (0.0, np.float32(0.6))


def test_the_first_mode_begins_where_the_robot_is(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  """Odometry may begin anywhere, and the mode be commanded or not."""
  for commanded in (False, True):
    walker, session = _controller(
      pretrained.load('quickstart'), tmp_path, monkeypatch
    )
    place = np.array([2.0, 1.0])
    robot = np.array([*place, 0.5, 1.0, *np.zeros(13)])
    sensed = controller_lib.sense(robot, np.zeros(16), 0.0)
    if commanded:
      walker.command(walker.mode['name'], place, np.zeros(2))
    walker.act(place, sensed)
    np.testing.assert_array_equal(walker.reference(), place)
    names = [p['name'] for p in walker.about['observation']]
    sizes = [p['size'] for p in walker.about['observation']]
    start = sum(sizes[: names.index('displacement')])
    np.testing.assert_array_equal(session.seen[0, start : start + 2], 0.0)


def test_a_map_tells_what_the_task_scans(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  ground = track.make('gap_block').generate(np.random.RandomState(0))
  controller, _ = _controller(pretrained.load('pi2'), tmp_path, monkeypatch)
  scans, ledges = [], []
  for x in np.arange(-0.5, 6.0, 0.05):
    controller.heading = x / 6
    qpos, qvel = np.full(17, x), np.full(16, 2 * x)
    pieces = np.concatenate(ground)
    support, ledge, scan = controller.look(pieces, qpos, qvel)
    at = x * (1 - 2 * observations.SCAN_AGE)
    at += np.cos(x / 6) * np.array(observations.SCAN)
    expected = terrain.profile(ground, at[None])[0]
    np.testing.assert_array_equal(scan + support, expected)
    assert support == terrain.support_height(ground, qpos[None, 0])[0]
    heights = terrain.profile(ground, x + np.array([[ledge + 1e-9]]))
    assert np.isinf(ledge) or abs(heights[0, 0] - support) > 0.02
    scans.append(scan)
    ledges.append(ledge)
  assert np.isneginf(scans).any() and np.max(scans) > 0.1
  assert ledges[0] > ledges[20] and ledges[-1] == np.inf
