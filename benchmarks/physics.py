"""What variants of the physics cost, and what they do to a policy's scores.

    python -m benchmarks.physics --policy=quickstart --out=physics.json

The default physics visits states under the policy. All variants step the very
same states and actions in turns, in an order that is drawn anew each time, raw:
nothing but Batch.step. Counted is the time of processors, not of the clock on
the wall, and ratios are within a round, so that other processes matter little.
The errors are how far that single control step, the same for all, ends from
where the default physics at 0.5 ms takes it: a variant whose errors are those
of the default is as good a model of the same robot, whatever a policy that
overfits one of them makes of it. Scores are those of
`dmc_multimode.bin.evaluate`.
"""

import contextlib
import functools
import pathlib
import sys
import time
from typing import Any, Mapping, NamedTuple, Sequence

from absl import flags
import mujoco
from mujoco import batch as mujoco_batch
import numpy as np
import torch
import tqdm

from benchmarks import common
from benchmarks import physics_variants as variants_lib
from dmc_multimode import pretrained
from dmc_multimode.arenas import track
from dmc_multimode.bin import app
from dmc_multimode.bin import config_flags
from dmc_multimode.bin import scoring
from dmc_multimode.modes import reference
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite import batched
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import episodes as episodes_lib
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite import observations

_POLICY = flags.DEFINE_string(
  'policy', 'quickstart', 'Name of a shipped policy, or a folder.'
)
_VARIANTS = flags.DEFINE_list(
  'variants', None, 'Names; all by default. The default physics is always in.'
)
_TIMESTEP = flags.DEFINE_float(
  'physics_timestep', None, 'Seconds; that of the training by default.'
)
_NUM_WORLDS = flags.DEFINE_integer(
  'num_worlds',
  32,
  'Worlds that are stepped together; the fewer, the closer are the turns.',
  lower_bound=1,
)
_THREADS = flags.DEFINE_integer(
  'threads', 1, 'Of the physics; speeds are per core anyway.', lower_bound=1
)
_ROUNDS = flags.DEFINE_integer(
  'rounds', 9, 'Medians are over these; 0 for scores alone.', 0
)
_SECONDS = flags.DEFINE_float(
  'seconds', 0.3, 'Of the default physics in a round.', lower_bound=0.001
)
_EPISODES = flags.DEFINE_integer(
  'episodes', 4, 'Like those of `evaluate`; 0 for speeds alone.', 0
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of all episodes.', 0)
_OUT = flags.DEFINE_string('out', None, 'JSON file to write.')

_SEGMENTS = 2  # Of the ground, as in training.
_BURN_IN = 60  # Control steps until episodes end at all times.
_SPACING = 7  # Control steps between the states that are measured.
_FINE = variants_lib.Variant(timestep=0.0005)
_LARGEST = 1.0  # Metres or radians that count of an error: some explode.

Row = dict[str, Any]


class Moment(NamedTuple):
  """Where measurements start: a state of all worlds, and their actions."""

  state: Mapping[str, np.ndarray]
  actions: np.ndarray


class Stepped(NamedTuple):
  """What one raw control step of all worlds did.

  Attributes:
    seconds: of processors.
    position: qpos afterwards, [B, 17].
    rows, contacts, iterations: constraint rows, contacts and iterations of the
      solver in the last physics step, means over the worlds.
  """

  seconds: float
  position: np.ndarray
  rows: float
  contacts: float
  iterations: float


class _Worlds(batched.BatchedImitation):
  """BatchedImitation on a variant of the physics."""

  def __init__(
    self,
    variant: variants_lib.Variant,
    policy: scoring.Policy,
    episodes: episodes_lib.EpisodeInitialiser,
    config: config_lib.ImitationConfig,
    arena: str | track.Track,
    num_worlds: int,
    auto_reset: bool = True,
  ):
    self._variant = variant
    self._task = multimode_biped.make_task(
      policy.motions,
      policy.codebook,
      episodes,
      arena,
      variant.configure(config),
    )
    for edit in variant.edits:
      edit(self._task)
    super().__init__(
      self._task, num_worlds, _SEED.value, _THREADS.value, auto_reset
    )

  def _set_up_physics(self, model: mujoco.MjModel, num_threads: int) -> None:
    super()._set_up_physics(
      self._variant.remodel(self._task, model), num_threads
    )
    self._rows, self._contacts = map(self.batch.bind, ('nefc', 'ncon'))
    self._islands = self.batch.bind('nisland')
    self._iterations = self.batch.bind('solver_niter')

  def step_raw(self, moment: Moment) -> Stepped:
    """Steps the physics alone from `moment` on."""
    self.restore(moment.state)
    self._ctrl[:] = moment.actions
    step = functools.partial(self.batch.step, nstep=self.config.substeps)
    variants_lib.set_profiler(self._variant.profiler)
    began = time.process_time()
    with contextlib.suppress(mujoco_batch.SimulationError):
      step()
    seconds = time.process_time() - began
    variants_lib.set_profiler(True)
    islands = np.arange(self._iterations.shape[1])
    solved = islands < np.maximum(self._islands, 1)[:, None]
    return Stepped(
      seconds,
      self.qpos.copy(),
      float(self._rows.mean()),
      float(self._contacts.mean()),
      float((self._iterations * solved).sum(axis=1).mean()),
    )


class _Evaluator(scoring.Evaluator):
  """Evaluates on a variant of the physics."""

  def __init__(
    self,
    variant: variants_lib.Variant,
    policy: pretrained.Policy,
    config: config_lib.ImitationConfig,
  ):
    super().__init__(
      policy, config_lib.for_evaluation(config), _SEED.value, quiet=True
    )
    self._variant = variant

  def make_worlds(self, schedule: schedule_lib.ModeSchedule) -> _Worlds:
    return _Worlds(
      self._variant,
      self.policy,
      episodes_lib.ScheduledEpisodes(schedule),
      self.config,
      'flat',
      len(schedule),
      auto_reset=False,
    )


class Course:
  """All variants on the states that the default physics visits."""

  def __init__(
    self,
    variants: Mapping[str, variants_lib.Variant],
    policy: pretrained.Policy,
    config: config_lib.ImitationConfig,
  ):
    """Compiles the models and collects the states."""
    episodes = episodes_lib.TransitionEpisodes(
      reference.ReferenceBank(policy.motions),
      commands_from_ground=config.commands_from_ground,
    )
    make = lambda variant: _Worlds(
      variant,
      policy,
      episodes,
      config,
      track.make('flat', _SEGMENTS),
      _NUM_WORLDS.value,
    )
    self._worlds = {name: make(variants[name]) for name in variants}
    self._moments = self._collect(make(variants[variants_lib.DEFAULT]), policy)
    fine = make(_FINE)
    self._fine = [fine.step_raw(moment).position for moment in self._moments]

  def _collect(
    self, worlds: _Worlds, policy: pretrained.Policy
  ) -> list[Moment]:
    """Lets the policy run until the moments take as long as is asked for."""
    moments, seconds, count = [], 0.0, 0
    observation = worlds.reset()
    while seconds < _SECONDS.value:
      actions = policy.select_action(observation)
      if count >= _BURN_IN and not count % _SPACING:
        moments.append(Moment(worlds.state(), actions))
        seconds += worlds.step_raw(moments[-1]).seconds
        worlds.restore(moments[-1].state)
      observation = worlds.step(actions).observation
      count += 1
    return moments

  def measure(self, rounds: int) -> list[Row]:
    """Returns what every variant costs."""
    seconds = {name: np.zeros(rounds) for name in self}
    steps: dict[str, list[Stepped]] = {name: [] for name in self}
    order = np.random.RandomState(_SEED.value)
    with tqdm.tqdm(total=rounds * len(self._moments), unit='state') as bar:
      for i in range(rounds):
        for moment in self._moments:
          for name in order.permutation(list(self)):
            stepped = self._worlds[name].step_raw(moment)
            seconds[name][i] += stepped.seconds
            steps[name] += [stepped] if i == 0 else []
          bar.update()
    return [self._row(name, seconds, steps[name]) for name in self]

  def __iter__(self) -> Any:
    return iter(self._worlds)

  def _row(
    self,
    name: str,
    seconds: Mapping[str, np.ndarray],
    steps: Sequence[Stepped],
  ) -> Row:
    mine = seconds[name]
    ratios = seconds[variants_lib.DEFAULT] / mine
    rates = _NUM_WORLDS.value * len(self._moments) / mine
    mean = lambda field: float(np.mean([getattr(s, field) for s in steps]))
    return {
      'name': name,
      'steps_per_second': float(np.median(rates)),
      'ratio': float(np.median(ratios)),
      'ratio_range': [float(ratios.min()), float(ratios.max())],
      'rows': mean('rows'),
      'contacts': mean('contacts'),
      'iterations': mean('iterations'),
      **self._errors([step.position for step in steps]),
    }

  def _errors(self, positions: Sequence[np.ndarray]) -> dict[str, float]:
    """Root mean squares; what is not a number counts as the largest."""
    errors = np.abs(np.array(positions) - np.array(self._fine))
    errors = np.nan_to_num(errors, nan=_LARGEST).clip(0.0, _LARGEST)
    trunk = np.linalg.norm(errors[..., :3], axis=-1)
    joints = errors[..., -observations.NUM_JOINTS :]
    return {
      'trunk_error': float(np.sqrt(np.mean(trunk**2))),
      'joint_error': float(np.sqrt(np.mean(joints**2))),
    }


def score(
  variant: variants_lib.Variant,
  policy: pretrained.Policy,
  config: config_lib.ImitationConfig,
) -> Row:
  """Returns the scores of `evaluate` on a variant of the physics."""
  evaluator = _Evaluator(variant, policy, config)
  report = scoring.report(evaluator, _EPISODES.value, clock_rate=1.0)
  kinds = ('modes', 'transitions')
  return {
    **{f'mra_{kind}': report[f'mra_{kind}']['mean'] for kind in kinds},
    **{f'survival_{kind}': report[f'survival_{kind}'] for kind in kinds},
  }


def compare(
  variants: Mapping[str, variants_lib.Variant],
  policy: pretrained.Policy,
  config: config_lib.ImitationConfig,
  out: pathlib.Path | None,
) -> list[Row]:
  """Returns the rows of the table; writes them as it goes."""
  rows: list[Row] = [{'name': name} for name in variants]
  if _ROUNDS.value:
    rows = Course(variants, policy, config).measure(_ROUNDS.value)
  _write(out, rows, config)
  if _EPISODES.value:
    for row in tqdm.tqdm(rows, unit='variant'):
      row |= score(variants[row['name']], policy, config)
      tqdm.tqdm.write(_line(row), sys.stderr)
      _write(out, rows, config)
  return rows


_COLUMNS = {  # Of the table: title, width and format.
  'steps_per_second': ('steps/s', 9, ',.0f'),
  'ratio': ('ratio', 7, '.3f'),
  'in_rounds': ('in the rounds', 16, 's'),
  'rows': ('rows', 7, '.2f'),
  'contacts': ('contacts', 10, '.2f'),
  'iterations': ('iterations', 12, '.2f'),
  'trunk_error': ('trunk m', 10, '.5f'),
  'joint_error': ('joints rad', 12, '.4f'),
  'mra_modes': ('MRA modes', 11, '.3f'),
  'mra_transitions': ('transitions', 13, '.3f'),
  'survival_modes': ('survival', 10, '.3f'),
  'survival_transitions': ('transitions', 13, '.3f'),
}
_NAME_WIDTH = 20


def _line(row: Row) -> str:
  if 'ratio_range' in row:
    row = row | {'in_rounds': '{:.3f} to {:.3f}'.format(*row['ratio_range'])}
  cells = [
    format(row[key], f'>{width}{form}') if key in row else ' ' * width
    for key, (_, width, form) in _COLUMNS.items()
  ]
  return row['name'].ljust(_NAME_WIDTH) + ''.join(cells)


def _print(rows: Sequence[Row]) -> None:
  titles = [title.rjust(width) for title, width, _ in _COLUMNS.values()]
  print(' ' * _NAME_WIDTH + ''.join(titles))
  for row in rows:
    print(_line(row))


def _write(
  out: pathlib.Path | None,
  rows: Sequence[Row],
  config: config_lib.ImitationConfig,
) -> None:
  report = {
    'benchmark': 'physics',
    'table': list(rows),
    'policy': _POLICY.value,
    'num_worlds': _NUM_WORLDS.value,
    'threads': _THREADS.value,
    'rounds': _ROUNDS.value,
    'seconds': _SECONDS.value,
    'episodes': _EPISODES.value,
    'seed': _SEED.value,
    'task': config_lib.to_dict(config),
  }
  common.write_report(out, report)


def _chosen() -> dict[str, variants_lib.Variant]:
  """Returns --variants by name; raises ValueError for those that are not."""
  known = variants_lib.VARIANTS
  names = _VARIANTS.value if _VARIANTS.value is not None else list(known)
  unknown = [name for name in names if name not in known]
  if unknown:
    raise ValueError(
      f'--variants: there is no {unknown[0]!r}; there are {", ".join(known)}.'
    )
  return {name: known[name] for name in [variants_lib.DEFAULT, *names]}


def main(argv: Sequence[str]) -> None:
  """Measures, evaluates, prints, writes."""
  del argv
  out = common.out_path(_OUT.value)
  variants, policy = _chosen(), pretrained.load(_POLICY.value)
  config = policy.config
  if _TIMESTEP.value is not None:
    config = config_flags.replace(config, physics_timestep=_TIMESTEP.value)
  torch.set_num_threads(_THREADS.value)
  mujoco.set_mju_user_warning(lambda text: None)  # Some variants explode.
  print(
    f'{_POLICY.value} at {1e3 * config.physics_timestep:g} ms, '
    f'{_NUM_WORLDS.value} worlds, {_THREADS.value} threads on '
    f'{common.CORES} cores, mujoco {mujoco.__version__}'
  )
  _print(compare(variants, policy, config, out))


def cli() -> None:
  """Runs."""
  app.run(main)


if __name__ == '__main__':
  cli()
