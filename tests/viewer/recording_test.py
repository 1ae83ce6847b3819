"""Tests of dmc_multimode.viewer: roll-outs, captions, recordings."""

import base64
import pathlib
import re
from typing import Any

import av
import numpy as np
import pytest

import dmc_multimode as dmm
from dmc_multimode import pretrained
from dmc_multimode import viewer
from dmc_multimode.modes import library
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.planner import plan as plan_lib
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.viewer import camera
from dmc_multimode.viewer import captions
from dmc_multimode.viewer import recording
from dmc_multimode.viewer import reference_rollout
from dmc_multimode.viewer import rollout
from dmc_multimode.viewer import video
from tests.planner import replay

_FOUR_LEGS = pathlib.Path(__file__).parents[1] / 'robots' / 'four_legs.yaml'


@pytest.mark.gl
def test_record(tmp_path: pathlib.Path) -> None:
  """A schedule, and a plan on its track, by names and by objects."""
  policy, out = pretrained.load('quickstart'), tmp_path / 'video.gif'
  small = viewer.RecordingConfig(width=32, height=16)
  course = plan_lib.Course('gap', {'width': 0.2}, 1)
  plan = plan_lib.PlanFile(plan_lib.ModePlan(('idle', 'idle'), 0.15), course)
  plan.write(tmp_path / 'plan.json')
  made = []
  for arguments in (
    {'policy': 'quickstart', 'schedule': 'walk_forward:0.12,idle:0.06'},
    {'policy': policy, 'schedule': [('walk_forward', 0.12), ('idle', 0.06)]},
    {'policy': policy, 'plan': plan},
    {'policy': 'quickstart', 'plan': tmp_path / 'plan.json'},
  ):
    made.append(viewer.record(**arguments, out=out, config=small, quiet=True))
    assert out.read_bytes().startswith(b'GIF8')
    out.unlink()
  assert made[0] == made[1] and made[2] == made[3]
  first, second = made[0].outcomes
  assert (first.mode, first.cause, made[0].steps) == ('walk_forward', 'none', 6)
  assert str(second).startswith('idle: survived, mean speed')
  assert [outcome.mode for outcome in made[2].outcomes] == ['idle']


@pytest.mark.gl
def test_two_policies_side_by_side(tmp_path: pathlib.Path) -> None:
  """Each as alone, but for its name in the picture."""
  small = viewer.RecordingConfig(width=128, height=128)
  record = lambda **more: viewer.record(
    'pi2',
    'idle:0.3',
    out=tmp_path / f'{len(more)}.mp4',
    config=small,
    quiet=True,
    **more,
  )
  alone, both = record(), record(compare='quickstart')
  assert both._replace(compared=None, out=alone.out) == alone
  assert both.compared is not None and both.compared.steps == 10
  assert both.compared.outcomes != alone.outcomes
  (tmp_path / '1.mp4').rename(tmp_path / 'both.mp4')
  # A video of before.
  beside = record(compare=tmp_path / '0.mp4')
  assert beside._replace(out=alone.out) == alone
  wide = viewer.RecordingConfig(width=144, height=128)
  with pytest.raises(ValueError, match='0.mp4 has another size'):
    viewer.record(
      'pi2',
      'idle:0.3',
      out=tmp_path / 'wide.mp4',
      config=wide,
      quiet=True,
      compare=tmp_path / '0.mp4',
    )
  assert not (tmp_path / 'wide.mp4').exists()
  frames = []
  for name in ('0.mp4', 'both.mp4', '1.mp4'):
    with av.open(str(tmp_path / name)) as container:
      decoded = container.decode(container.streams.video[0])
      frames.append([frame.to_ndarray(format='rgb24') for frame in decoded])
  for joined in frames[1:]:
    assert {frame.shape for frame in joined} == {(128, 256, 3)}
  twice = np.array(frames[2]).astype(int)
  assert np.abs(twice[:, :, :128] - twice[:, :, 128:]).mean() < 3
  # The ground below the robot, where no text is.
  left, right = (np.array(frames[1])[:, 112:, x : x + 128] for x in (0, 128))
  single = np.array(frames[0])[:, 112:].astype(int)
  assert np.abs(left - single).mean() < 3
  assert 0.1 < np.abs(right - single).mean() < 30


@pytest.mark.parametrize(
  ('arguments', 'message'),
  [
    ({}, 'a schedule or a plan'),
    ({'schedule': 'idle:1', 'plan': 'plan.json'}, 'a schedule or a plan'),
    ({'schedule': 'idle:1', 'out': 'video.avi'}, 'must end in .mp4'),
    ({'schedule': 'idle'}, 'idle'),
    ({'schedule': 'idle:inf'}, 'idle:inf'),
  ],
)
def test_record_rejects(arguments: dict[str, Any], message: str) -> None:
  with pytest.raises(ValueError, match=message):
    viewer.record('nobody', **arguments)


@pytest.mark.parametrize('slow', [1e-9, 0.0, 101.0, float('nan')])
def test_slow_motion_refused(slow: float) -> None:
  with pytest.raises(ValueError, match='^slow_motion: '):
    viewer.RecordingConfig(slow_motion=slow)


@pytest.mark.parametrize(
  ('changes', 'message'),
  [
    ({'clock_rate': 21.0}, 'its cycle of 0.6 s at .* 21 .* at most 20'),
    ({'durations': (0.01,)}, 'time_limit .* no room'),
  ],
)
def test_rollout_refused(changes: dict[str, Any], message: str) -> None:
  policy = pretrained.load('quickstart')
  fields = {'modes': ('walk_forward',), 'durations': (1.0,), **changes}
  with pytest.raises(ValueError, match=message):
    rollout.Rollout(policy, rollout.RolloutConfig(**fields)).start()


def test_pushes_as_in_the_plan() -> None:
  """The video's engine goes where the planner's does, bit for bit."""
  policy = pretrained.load('quickstart')
  pushes = (
    pushes_lib.Push(0.3, (-0.6, 0.2, 0.0)),
    pushes_lib.Push(0.0, (0.2, 0.0, 0.0)),
  )
  plan = plan_lib.ModePlan(('walk_forward', 'walk_forward', 'idle'), 0.3)
  config = reaching.ReachingConfig((0.5, 0.0, 0.5), 3, 0.3, seed=4)
  planned = replay.replay(policy, config, plan, pushes)
  names, durations = plan.segments()
  for pushed in (pushes, ()):
    roll = rollout.Rollout(
      policy,
      rollout.RolloutConfig(
        tuple(names), tuple(durations), seed=4, pushes=pushed
      ),
    )
    roll.start()
    path = np.array([step.position for step in roll.steps()])
    same = np.array_equal(path, planned.paths[0, : len(path)])
    assert same == bool(pushed)


def test_pushes_are_written_into_the_frames() -> None:
  policy = pretrained.load('quickstart')
  roll = rollout.Rollout(
    policy,
    rollout.RolloutConfig(
      ('idle',), (1.2,), pushes=(pushes_lib.Push(0.3, (0.5, 0.0, 0.0)),)
    ),
  )
  caption, frame = captions.Captions(roll), np.zeros((240, 320, 3), np.uint8)
  step = rollout.Step(0, 0.0, 'idle', np.zeros(3), 0.5, 0.5, 0.0, 1.0, 'none')
  texts = {
    time: caption.draw(frame, step._replace(time=time))[:220]
    for time in (0.29, 0.33, 0.89, 0.95)
  }
  heights = [(text > 0).any(axis=(1, 2)).sum() for text in texts.values()]
  assert heights[1] == heights[2] > heights[0] == heights[3]


def test_ledges_are_announced_when_they_appear() -> None:
  policy = pretrained.load('pi2')
  roll = rollout.Rollout(
    policy, rollout.RolloutConfig(('idle', 'launch'), (0.3, 1.5))
  )
  roll.start()
  watch, seen = captions._Ledges(roll.task.root_entity), []
  for step in roll.steps():
    seen.append(watch.lines(step))
  (line,) = {line for lines in seen for line in lines}
  assert line.startswith('block rises 0.3 m ahead: +0.40 m')
  (shown,) = np.nonzero([bool(lines) for lines in seen])
  assert 0.3 <= 0.03 * (shown[0] + 1) <= 0.36
  assert 0.03 * len(shown) == pytest.approx(0.6, abs=0.06)
  later = captions._Ledges(roll.task.root_entity)
  assert not later.lines(step)  # It was there before.


def test_trace_is_the_roll_out() -> None:
  found = viewer.trace('pi2', 'walk_forward:0.6,launch:1.2')
  assert found.times[-1] == pytest.approx(1.8)
  assert len(found.times) == len(found.position) == len(found.reference) == 60
  assert found.modes[0] == 'walk_forward' and found.modes[-1] == 'launch'
  assert set(found.causes) == {'none'} and found.reward.min() > 0.3
  np.testing.assert_allclose(found.position, found.reference, atol=0.25)
  assert set(found.support.round(6)) == {0.0, 0.4}
  with pytest.raises(ValueError, match='Unknown mode'):
    viewer.trace('pi2', 'fly:1')


@pytest.mark.gl
def test_a_notebook_shows_the_film(tmp_path: pathlib.Path) -> None:
  small = viewer.RecordingConfig(width=32, height=16)
  for suffix, kind in (('gif', 'image/gif'), ('mp4', 'video/mp4')):
    made = viewer.record(
      'quickstart',
      'idle:0.06',
      out=tmp_path / f'film.{suffix}',
      config=small,
      quiet=True,
    )
    content = re.search(f'data:{kind};base64,([^"]*)"', made._repr_html_())
    assert content
    assert base64.b64decode(content[1]) == made.out.read_bytes()


def test_a_film_of_a_plan_ends_when_the_robot_has_come_to_rest() -> None:
  """However long the plan rests: 1.5 s, of which it takes some to stand."""
  modes = library.mode_set('quickstart')
  plan = lambda names, *pushes: recording.planned(
    plan_lib.PlanFile(
      plan_lib.ModePlan(names, 0.3), plan_lib.Course('flat', pushes=pushes)
    ),
    modes,
  )
  walk = ('walk_forward',) * 4
  ends = {'modes': ('walk_forward', 'idle'), 'durations': (1.2, plan_lib.REST)}
  for names in (walk, (*walk, 'idle'), walk + ('idle',) * 20):
    found = plan(names)
    assert {key: found[key] for key in ends} == ends
  # A push in the rest is seen, and what follows it.
  late = pushes_lib.Push(3.0, (0.5, 0.0, 0.0))
  found = plan(walk + ('idle',) * 20, late)
  assert found['durations'] == pytest.approx((1.2, 3.0 - 1.2 + plan_lib.REST))
  assert plan(('idle',) * 9)['modes'] == ('idle',)


_BOW = """
name: bow
kind: transient
duration: 0.6
keyframes:
  - {phase: 0.0, position: [0, 0, 0.5]}
  - {phase: 0.5, position: [0.1, 0, 0.4], euler: [0, 40, 0]}
  - {phase: 1.0, position: [0, 0, 0.5]}
"""


@pytest.fixture
def bow(tmp_path: pathlib.Path) -> pathlib.Path:
  """A mode file."""
  path = tmp_path / 'bow.yaml'
  path.write_text(_BOW)
  return path


def test_a_reference_goes_where_its_keyframes_are(bow: pathlib.Path) -> None:
  modes = library.mode_set(bow)
  shown = reference_rollout.Reference(
    modes, task_config.ImitationConfig(feasible_references=False)
  )
  roll = reference_rollout.ReferenceRollout(
    shown, rollout.RolloutConfig(('bow',), (0.9,))
  )
  physics = roll.start()
  np.testing.assert_allclose(physics.data.qpos[:3], [0, 0, 0.5], atol=1e-9)
  steps, angles = [], []
  for step in roll.steps():
    steps.append(step)
    angles.append(motion_lib.tilt(physics.data.qpos[3:7])[1])
  assert len(steps) == 30 and {step.mode for step in steps} == {'bow'}
  np.testing.assert_allclose(steps[9].position, [0.1, 0, 0.4], atol=1e-9)
  np.testing.assert_allclose(np.degrees(angles[9]), 40.0)
  for step in steps[19:]:  # It holds its last pose.
    np.testing.assert_allclose(step.position, [0, 0, 0.5], atol=1e-9)
  assert steps[9].time == pytest.approx(0.3)
  (outcome,) = recording.outcomes(roll._config, np.zeros(3), steps)
  assert str(outcome) == 'bow: mean speed 0.00 m/s, peak height 0.50 m'


def test_a_film_of_a_reference_says_how_it_is_turned(
  bow: pathlib.Path,
) -> None:
  shown = reference_rollout.Reference(
    library.mode_set(bow), task_config.ImitationConfig()
  )
  roll = reference_rollout.ReferenceRollout(
    shown, rollout.RolloutConfig(('bow',), (0.3,))
  )
  roll.start()
  *_, step = roll.steps()
  lines = captions.Captions(roll).lines(step)
  assert lines == (
    '0.30 s, 0.33 m/s',
    'roll 0, pitch 40, yaw 0 deg',
    'feet free',
    'over ground 0.40 m',
    'over world 0.40 m',
    'box: reference of the trunk',
  )


def test_a_reference_goes_on_from_where_the_one_before_ends() -> None:
  modes = library.mode_set('walk_forward,launch')
  shown = reference_rollout.Reference(
    modes, task_config.ImitationConfig(feasible_references=False)
  )
  roll = reference_rollout.ReferenceRollout(
    shown, rollout.RolloutConfig(('walk_forward', 'launch'), (1.2, 1.2))
  )
  roll.start()
  steps = list(roll.steps())
  assert steps[39].position[0] == pytest.approx(2 * 0.36)
  # Onto the block that the mode asks for.
  end = steps[-1].position
  np.testing.assert_allclose(end, [0.72 + 0.6, 0.0, 0.9], atol=1e-6)
  assert steps[-1].height == pytest.approx(0.5)


@pytest.mark.gl
def test_a_film_of_a_mode_file_without_a_policy(
  bow: pathlib.Path, tmp_path: pathlib.Path
) -> None:
  small = viewer.RecordingConfig(width=64, height=64)
  out = tmp_path / 'bow.mp4'
  record = lambda **more: viewer.record(
    reference=bow, out=out, config=small, quiet=True, **more
  )
  made = record()  # Two cycles.
  assert [outcome.mode for outcome in made.outcomes] == ['bow']
  assert made.steps == 40
  frames = np.array(list(video.read_frames(out)), dtype=float)
  assert np.abs(frames[0] - frames[9])[20:50].mean() > 1.0  # It moves.
  with pytest.raises(ValueError, match="Unknown mode 'idle'"):
    record(schedule='idle:1')
  with pytest.raises(ValueError, match='no plan'):
    record(plan='plan.json')
  neither: dict[str, Any] = {}
  for wrong in (neither, {'policy': 'pi2', 'reference': bow}):
    with pytest.raises(ValueError, match='a policy or a reference'):
      viewer.record(schedule='idle:1', **wrong)


@pytest.mark.gl
def test_views_fit_the_robot() -> None:
  env = dmm.load('trot_forward', random=0, robot=_FOUR_LEGS)
  env.reset()
  size, position = env.task.config.robot.size, env.physics.data.qpos[:3]
  eye = camera.Camera(env.physics, env.task, 'side', 64, 64)
  eye.render()
  pose = eye._camera._render_camera
  assert size < 0.9 and pose.distance == pytest.approx(2.3 * size)
  aim = [position[0] + 0.15 * size, position[1], 0.45 * size]
  np.testing.assert_allclose(pose.lookat, aim, atol=1e-9)
