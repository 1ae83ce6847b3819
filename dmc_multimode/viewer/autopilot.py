"""Autopilot of a live session: a selector commands the robot."""

import math

import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.planner import selector as selector_lib
from dmc_multimode.planner import steering
from dmc_multimode.suite.imitation import observations
from dmc_multimode.suite.reaching import sensing
from dmc_multimode.utils import durations
from dmc_multimode.viewer import rollout

_FAR = 10.0  # Metres ahead: the goal of a track that never ends.


class Autopilot:
  """Chooses the modes of one robot, once a knot."""

  def __init__(
    self,
    selector: selector_lib.Selector,
    policy: pretrained.Policy,
    robot: rollout.Robot,
    goal: tuple[float, float, float] | None,
    seed: int = 0,
  ):
    """Takes a robot that has been started.

    Args:
      selector: made for the policy.
      policy: moves the robot.
      robot: to command.
      goal: of the trunk, world metres; None for as far as it gets.
      seed: of the errors of what it sees, which has none.

    Raises:
      ValueError: the selector is of a policy with other modes or observations.
    """
    self._selector, self._robot, self._goal = selector, robot, goal
    self._observer = sensing.Observer(policy, robot.task.core)
    steering.check(selector, policy.mode_set.names, self._observer.layout)
    self._random_state = np.random.RandomState(seed)
    self._knot_steps = durations.whole_steps(
      selector.knot_duration, robot.task.control_timestep, 'A knot'
    )
    self._steps = 0

  def choose(self) -> int | None:
    """Returns the mode to command now; None between knots.

    Call it once a control step. A blend that runs is left first.
    """
    due = not self._steps % self._knot_steps
    self._steps += 1
    if not due:
      return None
    core = self._robot.task.core
    if core.tracker.state.mode[0] >= len(self._selector.mode_names):
      return 0
    position = self._robot.position[None]
    goal = self._goal
    if goal is None:
      height = core.support(position[:, 0])[0] + core.config.robot.stand_height
      goal = position[0, 0] + _FAR, 0.0, float(height)
    seen = observations.flatten(self._robot.task.observation)
    observation = self._observer.observe(
      seen,
      position,
      sensing.Situation(np.array(goal), np.ones(1), np.zeros(1)),
      self._random_state,
    )
    if not math.isfinite(observation.sum()):
      return None
    return int(self._selector.select(observation, self._observer.obeyed())[0])
