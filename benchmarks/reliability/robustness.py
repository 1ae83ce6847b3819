"""Scores policies on other robots, on other ground, and under disturbances.

    python -m benchmarks.reliability.robustness --policy=pi2 --out=FILE.json
    python -m benchmarks.reliability.robustness --policy=pi2,pi_all --falls_only

Everything is judged by the code of `dmc_multimode.evaluation`, each case
apart: the physics in finer steps; the edges of blocks nearer or farther than
the references have them; the disturbances that `evaluate` fixes by its flags,
with the same meaning; weaker servos; pushes, which change the trunk's velocity
in a random horizontal direction once a second; obstacles, which every command
meets that can: gaps under leaps, other blocks, ledges ahead of gaits; and bumps
of the ground.

MRA and survival are those of `evaluate`. Where nothing but a fall ends an
episode, `did not fall` is the share of robots, one mode each, that stay up for
an episode of the task.
"""

import dataclasses
import functools
import itertools
import pathlib
from typing import Any, Mapping, Sequence

from absl import flags
import mujoco
import numpy as np
from numpy import typing as npt

from benchmarks import common
from dmc_multimode import pretrained
from dmc_multimode.arenas import layouts
from dmc_multimode.arenas import track
from dmc_multimode.bin import app
from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.evaluation import scores
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.suite.imitation import episodes
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.imitation import mujoco_worlds
from dmc_multimode.suite.imitation import terminations
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar
from dmc_multimode.utils import schedule as schedules

_POLICY = common.define_policy()
_CASES = flags.DEFINE_list('cases', None, 'Names; all by default.')
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Like those of `evaluate`.', lower_bound=1
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of initial states and pushes.', 0)
_OUT = common.define_out()
_FALLS_ONLY = flags.DEFINE_bool('falls_only', False, 'Only `did not fall`.')
_FALL_EPISODES = flags.DEFINE_integer(
  'fall_episodes', 256, 'For `did not fall`, of all modes together.', 1
)

_FALL_COLUMNS = (
  '=name | policy | did not fall=upright:.3f | '
  'in the worst=worst_upright:.3f | the worst mode=worst_fall'
)
_COLUMNS = (
  f'{_FALL_COLUMNS} | MRA modes=mra_modes:.3f | '
  'transitions=mra_transitions:.3f | survival=survival_modes:.3f | '
  'transitions=survival_transitions:.3f | worst transition=worst_transitions'
)
_PUSH_PERIOD = 1.0  # Seconds.


@dataclasses.dataclass(frozen=True)
class Case:
  """Makes it harder.

  Attributes:
    physics_timestep: seconds; `constants.PHYSICS_TIMESTEP` if None.
    edge: how much farther edges are, metres.
    push: least and largest velocity of a push a second, m/s.
    obstacles: share of the commands that meet one.
    torque_limit: of the servos, Nm; that of the robot if None.
    bumps: greatest height of bumps, metres.
    disturbed: arguments of `events.fixed`.
  """

  physics_timestep: float | None = None
  edge: float = 0.0
  push: tuple[float, float] = (0.0, 0.0)
  obstacles: float = 0.0
  torque_limit: float | None = None
  bumps: float = 0.0
  disturbed: Mapping[str, float] = dataclasses.field(default_factory=dict)


def _disturbed(**rows: float) -> Case:
  return Case(disturbed=rows)


_SLOPE = float(np.deg2rad(5.0))
CASES: Mapping[str, Case] = {
  'nominal': Case(),
  '2 ms': Case(physics_timestep=0.002),
  '1 ms': Case(physics_timestep=0.001),
  'edge 6 cm nearer': Case(edge=-0.06),
  'edge 6 cm farther': Case(edge=0.06),
  'mass -10 %': _disturbed(mass=0.9),
  'mass +10 %': _disturbed(mass=1.1),
  'payload 2 kg': _disturbed(payload=2.0),
  'friction 0.3': _disturbed(friction=0.3),
  'friction 0.4': _disturbed(friction=0.4),
  'friction 0.5': _disturbed(friction=0.5),
  'friction -10 %': _disturbed(friction=0.81),
  'friction +10 %': _disturbed(friction=0.99),
  'gains and torque 80 %': _disturbed(motor_strength=0.8),
  'torque limit 18 Nm': Case(torque_limit=18.0),
  'delay 10 ms': _disturbed(action_delay=0.01),
  'delay 20 ms': _disturbed(action_delay=0.02),
  'delay 30 ms': _disturbed(action_delay=0.03),
  'sensor noise': _disturbed(sensor_noise=1.0),
  'drifting odometry': _disturbed(odometry_drift=1.0),
  'pushes': Case(push=(0.3, 0.3)),
  'pushes 0.5 m/s': Case(push=(0.5, 0.5)),
  'pushes 0.5 to 1.0 m/s': Case(push=(0.5, 1.0)),
  'slope 5 degrees': _disturbed(slope=_SLOPE),
  'slope -5 degrees': _disturbed(slope=-_SLOPE),
  'bumps of 3 cm': Case(bumps=0.03),
  'obstacles': Case(obstacles=1.0),
}
_BUMP, _BUMPS = 0.3, 24  # Length in metres, and their number.


class Worlds(batched_env.BatchedImitation):
  """BatchedImitation in a `Case`; never begins anew by itself."""

  def __init__(
    self,
    case: Case,
    policy: evaluator_lib.Policy,
    schedule: schedule_lib.ModeSchedule,
    config: task_config.ImitationConfig,
    seed: int,
  ):
    """Compiles the task of `policy`, one world a row of `schedule`."""
    self._case = case
    self._pushes = np.random.RandomState(seed)
    self._steps = 0
    task = multimode_biped.make_task(
      dataclasses.replace(
        policy.mode_set,
        motions=tuple(
          _with_edge(motion, case.edge) for motion in policy.mode_set.motions
        ),
      ),
      episodes.ScheduledEpisodes(schedule),
      _bumpy(case.bumps) if case.bumps else 'flat',
      config=dataclasses.replace(
        config,
        events=dataclasses.replace(
          config.events, obstacles=schedules.constant(case.obstacles)
        ),
      ),
    )
    model = mujoco_worlds.compile_model(task)
    if case.torque_limit is not None:
      limit = case.torque_limit
      model.actuator_forcerange[:] = -limit, limit
    super().__init__(task, len(schedule), seed, auto_reset=False, model=model)

  def step(self, actions: npt.ArrayLike) -> batched_env.BatchedTimeStep:
    """Pushes if it is time to, and steps."""
    self._steps += 1
    if not self._steps % round(_PUSH_PERIOD / self.control_timestep):
      angle = self._pushes.uniform(0, 2 * np.pi, self.num_worlds)
      direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
      low, high = self._case.push
      shares = self._pushes.uniform(size=(self.num_worlds, 1))
      self.qvel[:, :2] += (low + shares * (high - low)) * direction
    return super().step(actions)


def _bumpy(height: float) -> track.Track:
  """Returns ground that is level to 0.6 m, then bumps up to `height` metres."""

  def layout(random_state: np.random.RandomState) -> list[layouts.Piece]:
    heights = random_state.uniform(0, height, _BUMPS)
    bumps = [layouts.Piece(_BUMP, float(bump)) for bump in heights]
    return [layouts.Piece(0.6), *bumps]

  # Room for the ledges of the modes of a transition.
  return track.Track(layout, 1 + _BUMPS + 2, adaptive=True)


def _with_edge(
  motion: motion_lib.ReferenceMotion, offset: float
) -> motion_lib.ReferenceMotion:
  """Returns the mode with the edge of its ledge moved by `offset`, metres."""
  if motion.ledge is None:
    return motion
  edge = motion.ledge.edge + offset
  return dataclasses.replace(
    motion, ledge=motion_lib.Ledge(edge, motion.ledge.height)
  )


class Evaluator(evaluator_lib.Evaluator):
  """Evaluates in a `Case`."""

  def __init__(self, case: Case, policy: pretrained.Policy, seed: int):
    """Evaluates `policy` from rest."""
    changes: dict[str, Any] = {'events': events.fixed(**case.disturbed)}
    if case.physics_timestep is not None:
      changes['physics_timestep'] = case.physics_timestep
    config = task_config.evaluated(policy.config, **changes)
    super().__init__(policy, config, seed, quiet=True)
    self._case = case

  def make_worlds(self, schedule: schedule_lib.ModeSchedule) -> Worlds:
    """Returns a world of the case for each row of `schedule`."""
    return Worlds(self._case, self.policy, schedule, self.config, self.seed)


def judge(
  name: str, policy: pretrained.Policy, episodes: int, seed: int
) -> common.Row:
  """Returns MRA and survival of `policy` in a case."""
  case = Evaluator(CASES[name], policy, seed)
  judged = {
    'modes': scores.evaluate_modes(case, scores.MODE_FACTOR * episodes, 1.0),
    'transitions': scores.evaluate_transitions(case, episodes),
  }
  row: common.Row = {}
  for kind, found in judged.items():
    for key in ('mra', 'survival'):
      row[f'{key}_{kind}'] = float(np.mean([r[key] for r in found.values()]))
    row[f'worst_{kind}'] = min(found, key=lambda label: found[label]['mra'])
  return row


def falls(
  name: str, policy: pretrained.Policy, episodes: int, seed: int
) -> common.Row:
  """Returns the share of robots that do not fall in a case.

  Args:
    name: of the case.
    policy: to judge.
    episodes: of all modes together.
    seed: of initial states and pushes.
  """
  case = Evaluator(CASES[name], policy, seed)
  free = case.changed(limits=terminations.falls_alone(case.config.limits))
  modes = np.arange(episodes) % len(policy.mode_set)
  found = free.run(schedule_lib.single(modes), name)
  shares = {
    policy.mode_set.names[i]: float(found.survived[modes == i].mean())
    for i in np.unique(modes)
  }
  worst = min(shares, key=shares.__getitem__)
  return {
    'upright': float(found.survived.mean()),
    'worst_upright': shares[worst],
    'worst_fall': worst,
  }


def main(argv: Sequence[str]) -> None:
  """Evaluates, prints, writes."""
  del argv
  out, names = files.output_file('out', _OUT.value), _CASES.value or [*CASES]
  for name in names:
    if name not in CASES:
      raise ValueError(f'--cases: {name!r} is not one of {", ".join(CASES)}.')
  policies = {name: pretrained.load(name) for name in _POLICY.value.split(',')}
  print(f'{_POLICY.value}, mujoco {mujoco.__version__}')
  columns = _FALL_COLUMNS if _FALLS_ONLY.value else _COLUMNS
  rows: list[common.Row] = []
  pairs = itertools.product(dict.fromkeys(names), policies)
  for name, policy in progress_bar.Bar([*pairs], unit='case'):
    row: common.Row = {'name': name, 'policy': pathlib.Path(policy).name}
    row |= falls(name, policies[policy], _FALL_EPISODES.value, _SEED.value)
    if not _FALLS_ONLY.value:
      row |= judge(name, policies[policy], _EPISODES.value, _SEED.value)
    rows.append(row)
    common.show(columns, row)
    report: common.Row = {'benchmark': 'robustness', 'table': rows}
    report |= {'policy': _POLICY.value, 'episodes': _EPISODES.value}
    report['fall_episodes'] = _FALL_EPISODES.value
    common.write_report(out, {**report, 'seed': _SEED.value})
  common.print_table(columns, rows)


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
