"""Advantages and losses of PPO."""

import torch

from dmc_multimode.agents import distributed


def generalised_advantages(
  rewards: torch.Tensor,
  values: torch.Tensor,
  next_values: torch.Tensor,
  discounts: torch.Tensor,
  last: torch.Tensor,
  gae_lambda: float,
) -> torch.Tensor:
  """Generalised advantage estimation (Schulman et al. 2016, Eq. 16).

  Args:
    rewards: r_t, [T, B].
    values: v(o_t), [T, B].
    next_values: v(o_{t+1}), of the observation before any reset, [T, B].
    discounts: gamma times the environment's discount, [T, B]: 0 where the
      episode terminated, gamma at a time limit.
    last: whether the episode ended with step t, [T, B]: no advantage flows
      across.
    gae_lambda: lambda.

  Returns:
    Advantages, [T, B].
  """
  deltas = rewards + discounts * next_values - values
  flows = discounts * gae_lambda * (~last)
  advantages = torch.empty_like(deltas)
  running = torch.zeros_like(deltas[0])
  for t in range(len(deltas) - 1, -1, -1):
    running = deltas[t] + flows[t] * running
    advantages[t] = running
  return advantages


def normalised(
  advantages: torch.Tensor,
  groups: torch.Tensor | None = None,
  communicator: distributed.Communicator = distributed.LOCAL,
) -> torch.Tensor:
  """Shifts and scales advantages to mean 0 and standard deviation 1.

  Args:
    advantages: [N].
    groups: index of the group in which each is normalised, [N]; one by default.
    communicator: of the ranks over whose advantages mean and deviation are.
  """
  if groups is None:
    _, mean, std = communicator.moments(advantages)
    return (advantages - mean) / (std + 1e-8)
  result = torch.zeros_like(advantages)
  # Collective operations: every rank loops over all groups.
  for group in range(int(communicator.gather(groups.max()[None]).max()) + 1):
    mine = groups == group
    count, mean, std = communicator.moments(advantages[mine])
    if count > 1:
      result[mine] = (advantages[mine] - mean) / (std + 1e-8)
  return result


def surrogate_loss(
  new_log_prob: torch.Tensor,
  old_log_prob: torch.Tensor,
  advantages: torch.Tensor,
  clip: float,
) -> tuple[torch.Tensor, torch.Tensor]:
  """The clipped surrogate objective (Schulman et al. 2017, Eq. 7), negated.

  Args:
    new_log_prob, old_log_prob: of the actions taken, [N].
    advantages: normalised, [N].
    clip: epsilon.

  Returns:
    The loss, and the share of samples whose ratio is beyond the clip; scalars.
  """
  ratio = torch.exp(new_log_prob - old_log_prob)
  clipped = ratio.clamp(1 - clip, 1 + clip)
  surrogate = torch.min(ratio * advantages, clipped * advantages)
  outside = (torch.abs(ratio.detach() - 1) > clip).float().mean()
  return -surrogate.mean(), outside
