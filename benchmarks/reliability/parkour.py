"""Crosses random tracks by plans and by a selector, under disturbances.

    python -m benchmarks.reliability.parkour --policy=pi2 --out=parkour.json

The tracks are `--tracks` draws of `parkour`: a gap, a plateau and a block of
random sizes in random order. Each is to be crossed by three controllers: the
plan of a guided search, carried out without looking (open loop); such plans,
made anew from where the robot is every `--replan_every` knots (replanning); and
the selector, which chooses at every knot by what it sees.

A search always plans for the nominal robot, which nobody pushes. Its plans are
carried out by the disturbed one:

  pushes: change the trunk's velocity about once a second, at knots, in a random
    horizontal direction; the same ones for all controllers.
  scan noise: of each height that the selector sees, anew at every knot. A
    search has a map in place of a scan, so that it concerns the selector alone.
  edges nearer, or farther: so the selector sees them, at every knot; and so
    they are on the map on which a search plans, also when it plans again.
  friction, motor strength, action delay: as in `robustness`.
"""

import dataclasses
import functools
from typing import Mapping, Sequence

from absl import flags

from benchmarks import common
from dmc_multimode import planner as planner_lib
from dmc_multimode.bin import app
from dmc_multimode.planner import pushes as pushes_lib
from dmc_multimode.planner import solver as solver_lib
from dmc_multimode.planner import steering
from dmc_multimode.suite.imitation import events
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.suite.reaching import sensing
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar

_POLICY = common.define_policy()
_TRACKS = flags.DEFINE_integer('tracks', 20, 'Seeds 0, 1, ... of tracks.', 1)
_CONDITIONS = flags.DEFINE_list('conditions', None, 'Names; all by default.')
_REPLAN_EVERY = flags.DEFINE_integer(
  'replan_every', 4, 'Knots after which replanning plans again.', 1
)
_SECONDS = flags.DEFINE_float(
  'seconds', None, 'Wall-clock budget of each planning; none by default.'
)
_SELECTOR = common.define_selector()
_OUT = common.define_out()

_COLUMNS = (
  'condition | open loop=open_loop:d | replanning:d | selector:d | of:d'
)


@dataclasses.dataclass(frozen=True)
class Condition:
  """Conditions that a robot meets and its planner does not know.

  Attributes:
    push_speed: of pushes about once a second, m/s.
    scan: errors of the ground as the selector sees it; `nearer` is also that of
      the map of a search.
    disturbed: arguments of `events.fixed`.
  """

  push_speed: float = 0.0
  scan: sensing.ScanErrors = sensing.EXACT
  disturbed: Mapping[str, float] = dataclasses.field(default_factory=dict)


CONDITIONS: Mapping[str, Condition] = {
  'nominal': Condition(),
  'pushes 0.5 m/s': Condition(push_speed=0.5),
  'scan noise 5 cm': Condition(scan=sensing.ScanErrors(noise=0.05)),
  'edges 5 cm nearer': Condition(scan=sensing.ScanErrors(nearer=0.05)),
  'edges 5 cm farther': Condition(scan=sensing.ScanErrors(nearer=-0.05)),
  'friction 0.5': Condition(disturbed={'friction': 0.5}),
  'motor strength 80 %': Condition(disturbed={'motor_strength': 0.8}),
  'action delay 20 ms': Condition(disturbed={'action_delay': 0.02}),
}


class Controllers:
  """The ways in which a policy crosses tracks."""

  names = ('open_loop', 'replanning', 'selector')

  def __init__(
    self,
    policy: str,
    folder: str = '',
    replan_every: int = 4,
    seconds: float | None = None,
  ):
    """Loads the selector.

    Args:
      policy: name or folder.
      folder: of the selector; by default the one beside the policy.
      replan_every: knots.
      seconds: budget of each planning, or None.

    Raises:
      FileNotFoundError: there is no such policy, or no selector.
      ValueError: `seconds` is not positive, or the selector damaged.
    """
    self._policy, self._folder = policy, folder
    self._replan_every, self._seconds = replan_every, seconds
    guided = planner_lib.GuidedConfig(folder=folder)
    solver_lib.check_seconds(seconds, guided)
    self._knot_duration = steering.load(guided.steering, policy).knot_duration

  def run(self, name: str, condition: Condition, seed: int) -> common.Row:
    """Returns how a controller crosses a track.

    Args:
      name: one of `names`.
      condition: that it meets.
      seed: of track, start and pushes.
    """
    config = reaching.in_knots(
      reaching.random_problem(seed), self._knot_duration
    )
    sees = name == 'selector'
    planner: solver_lib.PlannerConfig = (
      steering.SteeringConfig(self._folder, condition.scan)
      if sees
      else planner_lib.GuidedConfig(folder=self._folder)
    )
    found = planner_lib.solve(
      self._policy,
      reaching.RANDOM_TRACK,
      seed,
      config,
      planner=planner,
      pushes=pushes_lib.draw(
        condition.push_speed, config.knots, config.knot_duration, seed
      ),
      replan_every=self._replan_every if name == 'replanning' else 0,
      quiet=True,
      seconds=None if sees else self._seconds,
      disturbed=events.fixed(**condition.disturbed),
      map_error=0.0 if sees else condition.scan.nearer,
    )
    return {
      'controller': name,
      'seed': seed,
      'success': found.success,
      'goal': list(found.goal),
      'final_position': found.final_position.tolist(),
      'solve_seconds': found.solve_seconds,
      'plan': list(found.plan.modes),
    }


def concerned(condition: Condition) -> tuple[str, ...]:
  """Returns the controllers that a condition concerns."""
  return ('selector',) if condition.scan.noise else Controllers.names


def summary(name: str, runs: Sequence[common.Row]) -> common.Row:
  """Returns the row of the table; None for controllers without runs."""
  row: common.Row = {'condition': name}
  for controller in Controllers.names:
    mine = [run['success'] for run in runs if run['controller'] == controller]
    row[controller] = sum(mine) if mine else None
  return {**row, 'of': len({run['seed'] for run in runs})}


def main(argv: Sequence[str]) -> None:
  """Crosses the tracks, prints, writes."""
  del argv
  out = files.output_file('out', _OUT.value)
  names = dict.fromkeys(_CONDITIONS.value or CONDITIONS)
  for name in names:
    if name not in CONDITIONS:
      raise ValueError(
        f'--conditions: {name!r} is not one of {", ".join(CONDITIONS)}.'
      )
  controllers = Controllers(
    _POLICY.value, _SELECTOR.value, _REPLAN_EVERY.value, _SECONDS.value
  )
  table: list[common.Row] = []
  runs: list[common.Row] = []
  count = sum(len(concerned(CONDITIONS[name])) for name in names)
  with progress_bar.Bar(total=count * _TRACKS.value, unit='track') as progress:
    for name in names:
      condition, mine = CONDITIONS[name], []
      for seed in range(_TRACKS.value):
        for controller in concerned(condition):
          mine.append(controllers.run(controller, condition, seed))
          progress.update()
      table.append(summary(name, mine))
      runs += [{'condition': name, **run} for run in mine]
      common.show(_COLUMNS, table[-1])
      report: common.Row = {'benchmark': 'parkour', 'table': table}
      report |= {'runs': runs, 'policy': _POLICY.value}
      report |= {'tracks': _TRACKS.value, 'replan_every': _REPLAN_EVERY.value}
      common.write_report(out, {**report, 'seconds': _SECONDS.value})
  common.print_table(_COLUMNS, table)


cli = functools.partial(app.run, main)


if __name__ == '__main__':
  cli()
