"""Hyperparameters of PPO."""

import dataclasses
import math

ACTIVATIONS = ('elu', 'silu', 'tanh')
SYMMETRIES = ('none', 'augment', 'alternate')
ADVANTAGES = ('all', 'mode')


@dataclasses.dataclass(frozen=True)
class PPOConfig:
  """Everything that the learner can be tuned by.

  Attributes:
    hidden_sizes: widths of the hidden layers of policy and value networks.
    activation: of the hidden layers, 'elu', 'silu' or 'tanh'.
    rollout_length: control steps a world and iteration.
    discount: gamma.
    gae_lambda: lambda of generalised advantage estimation.
    epochs: passes over each iteration's data.
    minibatches: parts that each pass is cut into.
    clip: epsilon of the clipped surrogate objective.
    entropy_coefficient: weight of the entropy bonus.
    learning_rate: at the start.
    target_kl: the learning rate falls when an iteration moves the policy by
      more than twice this, KL divergence, median over the samples, and rises
      when by less than half; 0 keeps it fixed.
    min_learning_rate, max_learning_rate: bounds of the adaptation; they fall
      with the floor of the standard deviation, in units of which the policy
      moves.
    max_gradient_norm: the gradients of the policy, and those of the value
      function, are scaled down to it.
    initial_std: of the actions, radians.
    min_std: the standard deviation does not fall below; without a floor the
      exploration collapses early. It does not rise above `initial_std` either.
    final_min_std: where that floor ends: what is learned under much noise is
      not quite what is best without any.
    anneal_start, anneal_end: control steps of all worlds together between which
      the floor falls, geometrically, from `min_std` to `final_min_std`, and the
      ceiling likewise: by itself the deviation stays where it is.
    learn_std: whether the standard deviation is learned, or stays as it is.
    quiet_share: share of the worlds that take mean actions for a while, so that
      what a policy without exploration gets into is seen in training, too. The
      policy learns nothing from such actions, but from what it does after them.
    quiet_steps: how long such a while is on average, control steps.
    quiet_start: control steps of all worlds together before there is any.
    symmetry: 'augment' adds the left-right mirror image of every sample;
      'alternate' shows each pass either the sample or its image, at half of the
      cost.
    privileged_critic: whether the value function sees more than the policy, if
      the environment has more to show.
    anchor_weight: weight of the divergence from the policy that the training
      began with, if with any, in the modes that this one knows.
    advantages: normalised over 'all' samples, or over those of each 'mode', so
      that no mode's advantages outweigh the others'.
    compile: fits networks by `torch.compile`, which takes a C++ compiler, and
      most of a minute at the start; results round another way.
  """

  hidden_sizes: tuple[int, ...] = (256, 128)
  activation: str = 'silu'
  rollout_length: int = 8
  discount: float = 0.97
  gae_lambda: float = 0.95
  epochs: int = 3
  minibatches: int = 4
  clip: float = 0.2
  entropy_coefficient: float = 0.002
  learning_rate: float = 5e-4
  target_kl: float = 0.03
  min_learning_rate: float = 1e-4
  max_learning_rate: float = 2e-3
  max_gradient_norm: float = 1.0
  initial_std: float = 0.2
  min_std: float = 0.17
  final_min_std: float = 0.05
  anneal_start: int = 0
  anneal_end: int = 0
  learn_std: bool = True
  quiet_share: float = 0.0
  quiet_steps: int = 40
  quiet_start: int = 0
  symmetry: str = 'none'
  privileged_critic: bool = True
  advantages: str = 'all'
  anchor_weight: float = 0.0
  compile: bool = False

  def __post_init__(self) -> None:
    positive = (
      'rollout_length',
      'epochs',
      'minibatches',
      'clip',
      'learning_rate',
      'min_learning_rate',
      'max_learning_rate',
      'max_gradient_norm',
      'initial_std',
      'min_std',
      'final_min_std',
    )
    for name in positive:
      value = getattr(self, name)
      if not (math.isfinite(value) and value > 0):
        raise ValueError(f'{name} must be positive, got {value}.')
    for name in ('entropy_coefficient', 'target_kl', 'anchor_weight'):
      value = getattr(self, name)
      if not (math.isfinite(value) and value >= 0):
        raise ValueError(f'{name} must not be negative, got {value}.')
    if self.min_learning_rate > self.max_learning_rate:
      raise ValueError(
        f'min_learning_rate {self.min_learning_rate} is above '
        f'max_learning_rate {self.max_learning_rate}.'
      )
    if not 0 <= self.discount < 1:
      raise ValueError(f'discount must be in [0, 1), got {self.discount}.')
    if not 0 <= self.gae_lambda <= 1:
      raise ValueError(f'gae_lambda must be in [0, 1], got {self.gae_lambda}.')
    if not 0 <= self.quiet_share < 1:
      raise ValueError(
        f'quiet_share must be in [0, 1), got {self.quiet_share}.'
      )
    if self.quiet_steps < 1 or self.quiet_start < 0:
      raise ValueError(
        f'quiet_steps {self.quiet_steps} must be positive, and quiet_start '
        f'{self.quiet_start} not negative.'
      )
    if not 0 <= self.anneal_start <= self.anneal_end:
      raise ValueError(
        f'anneal_start {self.anneal_start} must not be negative nor later than '
        f'anneal_end {self.anneal_end}.'
      )
    if not self.hidden_sizes or min(self.hidden_sizes) < 1:
      raise ValueError('hidden_sizes needs at least one positive width.')
    for name, known in (
      ('activation', ACTIVATIONS),
      ('symmetry', SYMMETRIES),
      ('advantages', ADVANTAGES),
    ):
      if getattr(self, name) not in known:
        raise ValueError(
          f'{name} {getattr(self, name)!r} is not one of {known}.'
        )

  def std_bounds(self, steps: int) -> tuple[float, float]:
    """Returns the least and the largest std after `steps`, radians."""
    if steps >= self.anneal_end:
      share = 1.0 if self.anneal_end else 0.0
    else:
      span = self.anneal_end - self.anneal_start
      share = max(steps - self.anneal_start, 0) / span
    fall = (self.final_min_std / self.min_std) ** share
    return self.min_std * fall, max(self.initial_std, self.min_std) * fall
