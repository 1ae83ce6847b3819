"""The suite: `load` its tasks by name, or through dm_control's own `load`.

    from dmc_multimode import suite
    env = suite.load('multimode_biped', 'walk_forward')

Importing this module registers the domain, so that afterwards
`dm_control.suite.load('multimode_biped', 'walk_forward')` works as well.

The actions of most tasks are joint targets; those of the tasks `reach_*` are
modes, each commanded for a fraction of a second, and a trained policy is inside
(see `reaching.environment`).
"""

from typing import Any, Mapping

from dmc_multimode.utils import gl

# dm_control reads MUJOCO_GL when it is imported, which the next lines do.
gl.choose_late()

from dm_control import suite as dm_suite  # noqa: E402
import dm_env  # noqa: E402

from dmc_multimode.modes import library  # noqa: E402
from dmc_multimode.suite import multimode_biped  # noqa: E402

__all__ = [
  'ALL_TASKS',
  'DOMAIN',
  'FOUR_FOOTED',
  'load',
  'multimode_biped',
  'register',
]

DOMAIN = 'multimode_biped'
ALL_TASKS: tuple[tuple[str, str], ...] = tuple(
  (DOMAIN, name) for name in multimode_biped.SUITE
)
# Modes and sets of robots with four feet: tasks that need a `robot`.
FOUR_FOOTED: tuple[str, ...] = (*library.four_footed_modes(), 'quadruped')

# dm_control freezes its tuples of tasks at import: name -> tag of each.
_TAGGED = {
  'ALL_TASKS': None,
  'BENCHMARKING': 'benchmarking',
  'EASY': 'easy',
  'HARD': 'hard',
  'NO_REWARD_VIZ': 'no_reward_visualization',
}


def load(
  domain_name: str,
  task_name: str,
  task_kwargs: Mapping[str, Any] | None = None,
  environment_kwargs: Mapping[str, Any] | None = None,
  visualize_reward: bool = False,
) -> dm_env.Environment:
  """Returns an environment, with the signature of dm_control's `suite.load`.

  Args:
    domain_name: 'multimode_biped', or any domain of dm_control.
    task_name: of the task; or a mode or set of four feet, which is none of the
      tasks and needs a `robot`.
    task_kwargs: for the task's factory: `time_limit`, `random`; `robot` of
      modes and sets, `policy` of the tasks `reach_*`.
    environment_kwargs: for the environment's constructor.
    visualize_reward: shows the reward in the colour of the robot's eye (the
      tasks have dm_control's tag `no_reward_visualization`, which says that
      theirs are not the colours of its common materials).

  Raises:
    ValueError: the domain or task is unknown; the message lists ours.
  """
  if domain_name == DOMAIN and task_name in FOUR_FOOTED:
    environment = multimode_biped.imitation(
      task_name, environment_kwargs=environment_kwargs, **(task_kwargs or {})
    )
    environment.task.visualize_reward = visualize_reward
    return environment
  if domain_name == DOMAIN and task_name not in multimode_biped.SUITE:
    raise ValueError(
      f'Unknown task {task_name!r}; {DOMAIN} has '
      f'{", ".join(multimode_biped.SUITE)}.'
    )
  register()
  return dm_suite.load(
    domain_name, task_name, task_kwargs, environment_kwargs, visualize_reward
  )


def register() -> None:
  """Puts the domain into dm_control's registry; doing so again is harmless.

  Raises:
    ValueError: another domain of this name is registered already.
  """
  domains = dm_suite._DOMAINS  # The registry has no public door.
  registered = domains.get(DOMAIN)
  if registered is multimode_biped:
    return
  if registered is not None:
    raise ValueError(
      f'dm_control already has a domain {DOMAIN!r} ({registered}): remove it '
      'before importing dmc_multimode.suite.'
    )
  domains[DOMAIN] = multimode_biped
  for name, tag in _TAGGED.items():
    setattr(dm_suite, name, dm_suite._get_tasks(tag))
  everything = set(dm_suite.ALL_TASKS)
  dm_suite.EXTRA = tuple(sorted(everything - set(dm_suite.BENCHMARKING)))
  dm_suite.REWARD_VIZ = tuple(sorted(everything - set(dm_suite.NO_REWARD_VIZ)))
  dm_suite.TASKS_BY_DOMAIN = dm_suite._get_tasks_by_domain(dm_suite.ALL_TASKS)


register()
