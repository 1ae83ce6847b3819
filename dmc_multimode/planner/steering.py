"""Steering: a mode selector commands a robot to its goal, in closed loop.

What it commanded is a plan like a search's, and is written as one; but it did
not need a simulator, and saw the robot and the ground at every knot.
"""

import os
import time
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np

from dmc_multimode.planner import problem as problem_lib
from dmc_multimode.suite.reaching import environment
from dmc_multimode.suite.reaching import problem as reaching
from dmc_multimode.suite.reaching import sensing
from dmc_multimode.utils import config as config_lib

if TYPE_CHECKING:
  from dmc_multimode.planner import selector as selector_lib

BESIDE = 'selector'  # Folder of the selector in the folder of its policy.


@config_lib.dataclass
class SteeringConfig:
  """A selector in the place of a planner.

  Attributes:
    folder: of the selector; by default the one beside the policy.
    scan_errors: of the ground as it sees it.
  """

  folder: str = ''
  scan_errors: sensing.ScanErrors = sensing.EXACT


class Steered(NamedTuple):
  """Commands of a selector, and their outcome.

  Attributes:
    modes: mode indices, one a knot, [K].
    trials: of the one robot.
    decision_seconds: time that each choice took, [K].
  """

  modes: np.ndarray
  trials: problem_lib.Trials
  decision_seconds: np.ndarray


def load(
  config: SteeringConfig, policy: str | os.PathLike[str] | reaching.Policy
) -> 'selector_lib.Selector':
  """Loads the selector of a configuration.

  Args:
    config: names its folder, or none.
    policy: the low-level policy, beside which it is by default.

  Raises:
    FileNotFoundError: there is no selector.
    ValueError: its files are damaged, or `policy` is an object that is in no
      folder.
  """
  from dmc_multimode.planner import selector as selector_lib

  if config.folder:
    return selector_lib.load(config.folder)
  if not isinstance(policy, (str, os.PathLike)):
    raise ValueError(
      'The policy is an object: name the folder of its selector.'
    )
  if not is_beside(policy):
    raise FileNotFoundError(
      f'The policy {os.fspath(policy)} has no selector beside it: train one by '
      'train_selector, and name its folder.'
    )
  return selector_lib.load(environment.find_policy(policy) / BESIDE)


def is_beside(policy: str | os.PathLike[str]) -> bool:
  """Returns whether a policy has a selector beside it."""
  return (environment.find_policy(policy) / BESIDE).is_dir()


def check(
  selector: 'selector_lib.Selector',
  mode_names: tuple[str, ...],
  layout: sensing.Layout,
) -> None:
  """Raises ValueError for a selector of another policy.

  Args:
    selector: to check.
    mode_names: of the policy.
    layout: of the observations of its worlds.
  """
  if (selector.mode_names, selector.layout) != (mode_names, layout):
    raise ValueError(
      f'The selector is made for the policy {selector.policy}: for modes '
      f'{", ".join(selector.mode_names)} and what that policy observes.'
    )


def steer(
  robot: problem_lib.ReachingProblem, selector: 'selector_lib.Selector'
) -> Steered:
  """Commands a robot from where it is to its last knot.

  Args:
    robot: a problem of one world.
    selector: made for its policy.

  Raises:
    ValueError: the selector is of a policy with other modes or observations.
  """
  check(selector, robot.mode_set.names, robot.layout)
  modes, knots, seconds = [], [], []
  while robot.remaining:
    seen, obeyed = robot.observe(), robot.obeyed()
    began = time.perf_counter()
    chosen = selector.select(seen, obeyed)
    seconds.append(time.perf_counter() - began)
    modes.append(int(chosen[0]))
    knots.append(robot.run_knot(chosen))
  return Steered(
    np.array(modes),
    problem_lib.trials(knots, robot.rest()),
    np.array(seconds),
  )


def details(steered: Steered) -> dict[str, Any]:
  """Returns the median and the 99th percentile of the choices' times, ms."""
  median, high = np.percentile(1e3 * steered.decision_seconds, [50, 99])
  return {'decision_ms': float(median), 'decision_ms_p99': float(high)}
