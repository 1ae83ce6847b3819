"""Our PPO, rsl_rl's and Stable-Baselines3's: speed, and what they learn.

    python -m benchmarks.learning.learning --modes=pi2 --out=learning.json

The same task, networks of the same size and initial weights, and the same
hyperparameters on the same cores (`learners` says what differs). All train in
turns, iteration after iteration, and are compared with the first of --learners
within each round: noise of the machine hits all alike. The update is what comes
between two rollouts: returns, advantages and all passes over the samples. What
they have learned is judged by the code of `dmc_multimode.evaluation`: mean
actions, from rest. Hyperparameters are our defaults, without symmetry and
privileged information, which not all of them know.

What a library learns in minutes through its adapter, beside the untrained
networks' return (`gain`):

    python -m benchmarks.learning.learning --learners=sb3,rsl_rl \
      --modes=walk_forward --num_worlds=64 --steps=150000 --rounds=1 \
      --eval_steps=0,150000
"""

import math
import pathlib
import sys
import time
from typing import Any, Mapping, NamedTuple, Sequence

from absl import flags
import numpy as np

from benchmarks import common
from benchmarks.learning import learners
from dmc_multimode.bin import app
from dmc_multimode.evaluation import evaluator as evaluator_lib
from dmc_multimode.evaluation import scores
from dmc_multimode.experiments import config as run_config
from dmc_multimode.modes import schedule as schedule_lib
from dmc_multimode.suite.imitation import batched_env
from dmc_multimode.suite.imitation import config as task_config
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar

_LEARNERS = flags.DEFINE_list(
  'learners',
  list(learners.ALIKE),
  f'Of {", ".join(learners.NAMES)}; the others are compared to the first.',
)
_STEPS = flags.DEFINE_integer(
  'steps', 5_000_000, 'Control steps of each learner; 0 for --rounds.', 0
)
_EVAL_STEPS = flags.DEFINE_list(
  'eval_steps',
  ['2000000', '5000000'],
  'Steps after which to evaluate; 0 is before the first.',
)
_ROUNDS = flags.DEFINE_integer(
  'rounds', 15, 'First iterations, after one, whose median is the speed.', 1
)
_SCALE_REWARDS = flags.DEFINE_bool(
  'scale_rewards', True, 'Libraries get rewards times 1 - gamma; else raw.'
)
_OUT = common.define_out()
common.define_run_flags()

_SHARED = ('--ppo_symmetry=none', '--noppo_privileged_critic')
_EPISODES = 4  # As `evaluate` runs by default.
_MICRO = 1e6

Row = common.Row
_SPEED = (
  '=name | steps/s=steps_per_second:,.0f | '
  'ratio=steps_per_second_ratio:.2f | update us=update_us_per_sample:.1f | '
  'ratio=update_ratio:.2f | in the rounds=update_ratio_range:.2f | '
  'besides us=besides_us_per_sample:.1f | ratio=besides_ratio:.2f'
)
_LEARNED = (
  '=name | steps:,d | steps/s=steps_per_second:,.0f | '
  'MRA modes=mra_modes:.3f | gain=gain:.2f | transitions=mra_transitions:.3f | '
  'survival=survival_modes:.3f | transitions=survival_transitions:.3f'
)


class Lap(NamedTuple):
  """Seconds of one iteration: in all, of the update, of environment.step."""

  total: float
  update: float
  environment: float


class Result(NamedTuple):
  """Measurements: rows of the tables, for printing and JSON."""

  speed: list[Row]
  learning: list[Row]


class _Evaluator(evaluator_lib.Evaluator):
  """Tells a policy that remembers when episodes begin."""

  policy: learners.Learner

  def make_worlds(
    self, schedule: schedule_lib.ModeSchedule
  ) -> batched_env.BatchedImitation:
    self.policy.begin_episodes()
    return super().make_worlds(schedule)


def drive(learner: learners.Learner) -> Lap:
  """Runs one iteration."""
  step = ((batched_env.BatchedImitation, 'step'),)
  with (
    learners.timing(learner.update) as update,
    learners.timing(step) as environment,
  ):
    began = time.perf_counter()
    learners.iterate(learner)
    total = time.perf_counter() - began
  return Lap(total, sum(update), sum(environment))


def judge(
  learner: learners.Learner, config: run_config.RunConfig
) -> dict[str, Any]:
  """Returns the report of `evaluate` on what has been learned."""
  task = task_config.evaluated(config.task)
  evaluator = _Evaluator(learner, task, config.seed)
  return scores.report(evaluator, _EPISODES, clock_rate=1.0)


def compare(
  config: run_config.RunConfig,
  names: Sequence[str],
  eval_steps: Sequence[int],
  out: pathlib.Path | None,
) -> Result:
  """Trains all in turns; measures, evaluates and writes as it goes."""
  contest = {
    name: learners.make(name, config, _SCALE_REWARDS.value) for name in names
  }
  samples = config.num_worlds * config.ppo.rollout_length
  rounds = max(1 + _ROUNDS.value, math.ceil(_STEPS.value / samples))
  laps: dict[str, list[Lap]] = {name: [] for name in names}
  due, result = list(eval_steps), Result([], [])
  with progress_bar.Bar(total=rounds * len(names), unit='iteration') as bar:
    for done in range(rounds + 1):
      for name, learner in contest.items() if done else ():
        laps[name].append(drive(learner))
        bar.update()
      if done == 1 + _ROUNDS.value:
        result = result._replace(speed=speeds(laps, samples))
        _write(out, config, result)
      while due and due[0] <= done * samples:
        due.pop(0)
        for name, learner in contest.items():
          report = judge(learner, config)
          row = _learned(name, done * samples, laps[name], report)
          firsts = [one for one in result.learning if one['name'] == name]
          basis = (firsts or [row])[0]['mra_modes']
          row['gain'] = row['mra_modes'] / basis if basis else math.nan
          result.learning.append(row)
          common.show(_LEARNED, row)
        _write(out, config, result)
  return result


def speeds(laps: Mapping[str, list[Lap]], samples: int) -> list[Row]:
  """Returns medians over the rounds but the first, in which much is allocated.

  Args:
    laps: of every learner, in the same rounds.
    samples: control steps of a lap.
  """
  measured = {name: np.array(mine[1:]).T for name, mine in laps.items()}
  basis, *_ = measured.values()
  rows = []
  for name, (total, update, environment) in measured.items():
    ratios = update / basis[1]
    besides = total - environment
    rows.append(
      {
        'name': name,
        'steps_per_second': samples / float(np.median(total)),
        'steps_per_second_ratio': float(np.median(basis[0] / total)),
        'update_us_per_sample': _MICRO * float(np.median(update)) / samples,
        'update_ratio': float(np.median(ratios)),
        'update_ratio_range': [float(ratios.min()), float(ratios.max())],
        'besides_us_per_sample': _MICRO * float(np.median(besides)) / samples,
        'besides_ratio': float(np.median(besides / (basis[0] - basis[2]))),
      }
    )
  return rows


def _learned(
  name: str, steps: int, laps: Sequence[Lap], report: Mapping[str, Any]
) -> Row:
  seconds = sum(lap.total for lap in laps)
  kept = ('modes', 'transitions', 'survival_modes', 'survival_transitions')
  return {
    'name': name,
    'steps': steps,
    'seconds': seconds,
    'steps_per_second': steps / seconds if steps else 0.0,
    'mra_modes': report['mra_modes']['mean'],
    'mra_transitions': report['mra_transitions']['mean'],
    **{key: report[key] for key in kept},
  }


def _write(
  out: pathlib.Path | None, config: run_config.RunConfig, result: Result
) -> None:
  report = {
    'benchmark': 'learning',
    **result._asdict(),
    'rounds': _ROUNDS.value,
    'scale_rewards': _SCALE_REWARDS.value,
    'config': run_config.to_dict(config),
  }
  packages = ('rsl-rl-lib', 'stable-baselines3', 'tensordict', 'gymnasium')
  common.write_report(out, report, packages)


def _eval_steps() -> list[int]:
  """Returns --eval_steps in order; raises ValueError if they are of no use."""
  try:
    steps = sorted({int(item) for item in _EVAL_STEPS.value})
  except ValueError as error:
    raise ValueError(f'--eval_steps needs integers: {error}') from error
  if steps and (steps[0] < 0 or steps[-1] > _STEPS.value):
    raise ValueError(
      f'--eval_steps={",".join(_EVAL_STEPS.value)} must be from 0 to '
      f'--steps={_STEPS.value}.'
    )
  return steps


def main(argv: Sequence[str]) -> None:
  """Measures, prints, writes."""
  del argv
  out = files.output_file('out', _OUT.value)
  names, eval_steps = list(dict.fromkeys(_LEARNERS.value)), _eval_steps()
  if not names:
    raise ValueError(f'--learners: name some of {learners.NAMES}.')
  config = common.configured()
  ppo = config.ppo
  print(
    f'{common.describe(config)}, {ppo.rollout_length} steps, {ppo.epochs} '
    f'epochs x {ppo.minibatches} minibatches'
  )
  result = compare(config, names, eval_steps, out)
  common.print_table(_SPEED, result.speed)
  print('besides: all but environment.step; us: microseconds a sample')
  if result.learning:
    common.print_table(_LEARNED, result.learning)


def cli() -> None:
  """Runs with what all learners know, unless flags say otherwise."""
  app.run(main, [sys.argv[0], *_SHARED, *sys.argv[1:]])


if __name__ == '__main__':
  cli()
