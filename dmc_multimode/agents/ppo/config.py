"""Hyperparameters of PPO."""

from typing import Annotated, Any, Mapping

import pydantic

from dmc_multimode.utils import config
from dmc_multimode.utils import schedule

ACTIVATIONS = ('elu', 'silu', 'tanh')
SYMMETRIES = ('none', 'augment', 'alternate')
ADVANTAGES = ('all', 'mode')
_BelowOne = Annotated[float, pydantic.Field(ge=0, lt=1)]
_Sizes = Annotated[tuple[config.PositiveInt, ...], pydantic.Field(min_length=1)]


@config.dataclass
class PPOConfig:
  """Configuration of the PPO learner.

  Attributes:
    hidden_sizes: widths of the hidden layers of policy and value networks.
    activation: of the hidden layers, 'elu', 'silu' or 'tanh'.
    rollout_length: control steps per world and iteration.
    discount: gamma.
    gae_lambda: lambda of generalised advantage estimation.
    epochs: passes over each iteration's data.
    minibatches: parts that each pass is cut into.
    clip: epsilon of the clipped surrogate objective.
    entropy_coefficient: weight of the entropy bonus.
    learning_rate: initial learning rate.
    target_kl: the learning rate falls when an iteration moves the policy by
      more than twice this, KL divergence, median over the samples, and rises
      when by less than half; 0 keeps it fixed.
    min_learning_rate, max_learning_rate: bounds of the adaptation; they fall
      with the floor of the standard deviation, in units of which the policy
      moves.
    max_gradient_norm: the gradients of the policy, and those of the value
      function, are scaled down to it.
    initial_std: standard deviation of the actions at the start, radians.
    std_floor: lower bound of the standard deviation, radians, a geometric
      schedule; without it exploration collapses early. The upper bound begins
      at `initial_std` and falls in proportion, because the deviation would not
      fall by itself. A policy learned under much noise is not the best without
      noise, so the floor ends lower.
    learn_std: learns the standard deviation, which is constant otherwise.
    deterministic_fraction: share of the worlds that act without exploration
      noise for a while, a schedule, so that training visits the states of the
      deterministic policy. The policy learns nothing from these actions, but
      from those that follow.
    deterministic_steps: mean length of such periods, control steps.
    symmetry: 'augment' adds the left-right mirror image of every sample;
      'alternate' shows each pass either the sample or its image, at half of the
      cost.
    privileged_critic: shows the value function the privileged observations, if
      the environment has any.
    advantages: normalised over 'all' samples, or over those of each 'mode', so
      that no mode's advantages outweigh the others'.
    kickstarting_weight: weight of the divergence from the initial policy of a
      fine-tuning, in the modes that this policy knows.
  """

  hidden_sizes: _Sizes = (256, 128)
  activation: Annotated[str, config.one_of(ACTIVATIONS)] = 'silu'
  rollout_length: config.PositiveInt = 8
  discount: _BelowOne = 0.97
  gae_lambda: config.Share = 0.95
  epochs: config.PositiveInt = 3
  minibatches: config.PositiveInt = 4
  clip: config.Positive = 0.2
  entropy_coefficient: config.NonNegative = 0.002
  learning_rate: config.Positive = 5e-4
  target_kl: config.NonNegative = 0.03
  min_learning_rate: config.Positive = 1e-4
  max_learning_rate: config.Positive = 2e-3
  max_gradient_norm: config.Positive = 1.0
  initial_std: config.Positive = 0.2
  std_floor: schedule.GeometricField = schedule.constant(0.17)
  learn_std: bool = True
  deterministic_fraction: schedule.ShareField = schedule.constant(0.0)
  deterministic_steps: config.PositiveInt = 40
  symmetry: Annotated[str, config.one_of(SYMMETRIES)] = 'none'
  privileged_critic: bool = True
  advantages: Annotated[str, config.one_of(ADVANTAGES)] = 'all'
  kickstarting_weight: config.NonNegative = 0.0

  def __post_init__(self) -> None:
    if self.min_learning_rate > self.max_learning_rate:
      raise ValueError(
        f'min_learning_rate {self.min_learning_rate} is above '
        f'max_learning_rate {self.max_learning_rate}'
      )
    if self.most_deterministic >= 1:
      raise ValueError('deterministic_fraction of 1 leaves nothing to learn')

  @property
  def most_deterministic(self) -> float:
    """Largest share of worlds that act without noise, over all steps."""
    return self.deterministic_fraction.largest

  def std_bounds(self, steps: int) -> tuple[float, float]:
    """Returns the bounds of the std after `steps`, radians."""
    floor = self.std_floor
    fall = (floor.last / floor.first) ** floor.share(steps)
    return floor.first * fall, max(self.initial_std, floor.first) * fall


def upgraded(values: Mapping[str, Any]) -> dict[str, Any]:
  """Returns an earlier version's JSON with this version's keys.

  Raises:
    KeyError: a field is missing.
  """
  new = dict(values)
  new.pop('compile', None)
  if 'std_floor' in new:
    return new
  std, final = new.pop('min_std'), new.pop('final_min_std')
  start, end = new.pop('anneal_start'), new.pop('anneal_end')
  new['std_floor'] = (
    {'first': std, 'last': final, 'start': start, 'end': end} if end else std
  )
  share, start = new.pop('quiet_share', 0.0), new.pop('quiet_start', 0)
  new['deterministic_fraction'] = (
    {'first': 0.0, 'last': share, 'start': start, 'end': start}
    if start
    else share
  )
  for old, name in (
    ('quiet_steps', 'deterministic_steps'),
    ('anchor_weight', 'kickstarting_weight'),
  ):
    if old in new:
      new[name] = new.pop(old)
  return new
