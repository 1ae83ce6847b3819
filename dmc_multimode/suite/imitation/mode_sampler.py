"""The modes that an episode practises: Algorithm 1 of Krishna and Nguyen.

An episode begins in mode m_i, drawn from p_i, and switches to m_f, drawn from
p_f(. | m_i). After it, with its normalised return R,

    R_i[m_i]      <- gamma_i R_i[m_i]      + R
    R_f[m_i, m_f] <- gamma_f R_f[m_i, m_f] + R
    p_i = RETURNS2PROB(R_i),  p_f(. | m_i) = RETURNS2PROB(R_f[m_i])

    RETURNS2PROB(R):  K <- -R;  K <- K - min K;  K <- K / max K;
                      K <- K + epsilon;  p <- K / sum K

so that modes and transitions with poor returns are practised more. The baseline
draws uniformly. A third sampler counts failures: the probability of a pair is
in proportion to an upper confidence bound of the share of its episodes that
terminate early,

    u = p + sqrt(p (1 - p) / (n + 2)),   p = (failures + 1) / (n + 2),

with n and the failures of about its last 100 episodes.
"""

from typing import Annotated, Any, Mapping

import numpy as np
import pydantic

from dmc_multimode.suite.imitation import disturbances
from dmc_multimode.utils import config as config_lib
from dmc_multimode.utils import schedule

KINDS = ADAPTIVE, FAILURES, UNIFORM = 'adaptive', 'failures', 'uniform'
_FAILURE_MEMORY = 0.99  # Of the counts of a pair, at each of its episodes.
_Memory = Annotated[float, pydantic.Field(ge=0, lt=1)]


@config_lib.dataclass
class SamplingConfig:
  """Parameters of Algorithm 1, and of the preferences that override it.

  Attributes:
    kind: 'adaptive' is Algorithm 1, 'failures' counts failures, 'uniform' draws
      all modes and transitions alike.
    gamma_initial: memory gamma_i of the modes' returns, in [0, 1).
    gamma_final: memory gamma_f of the transitions' returns, in [0, 1).
    epsilon: offset that keeps the best mode in the draw.
    gait_fraction: probability that a drawn mode is replaced by a gait, a mode
      that steps with one foot at a time; a schedule. A policy that learns to
      bound on both feet first bounds in its gaits, too.
    focus: names of modes that replace a drawn mode likewise, comma-separated.
    focus_fraction: probability that they do; a schedule.
    focus_end: environment steps after which they no longer do; 0 for no end.
    clock_rates: range of the clock rates of some episodes, for modes that have
      no flight up to the speed at which legs begin to run. Modes that climb or
      descend keep theirs, 1.
    clock_rate_fraction: share of the episodes that draw theirs; a schedule.
    string_fraction: share of the episodes that last twice as long and have up
      to five commands; a schedule.
  """

  kind: Annotated[str, config_lib.one_of(KINDS)] = ADAPTIVE
  gamma_initial: _Memory = 0.8
  gamma_final: _Memory = 0.8
  epsilon: config_lib.NonNegative = 0.2
  gait_fraction: schedule.ShareField = schedule.constant(0.0)
  focus: str = ''
  focus_fraction: schedule.ShareField = schedule.constant(0.5)
  focus_end: config_lib.Count = 0
  clock_rates: disturbances.Range = (1.0, 1.0)
  clock_rate_fraction: schedule.ShareField = schedule.constant(0.5)
  string_fraction: schedule.ShareField = schedule.constant(0.0)

  def __post_init__(self) -> None:
    if self.clock_rates[0] <= 0:
      raise ValueError(f'clock_rates are positive, got {self.clock_rates}')

  @property
  def has_strings(self) -> bool:
    """True if an episode may have more than two commands."""
    return self.string_fraction.largest > 0

  @property
  def focused(self) -> tuple[str, ...]:
    """The names in `focus`."""
    return tuple(name.strip() for name in self.focus.split(',') if name.strip())

  def focus_at(self, steps: int) -> float:
    """Returns the probability that a mode of `focus` replaces a drawn one."""
    if self.focus_end and steps >= self.focus_end:
      return 0.0
    return self.focus_fraction.at(steps)


def upgraded(values: Mapping[str, Any]) -> dict[str, Any]:
  """Returns an earlier version's JSON with this version's keys."""
  new = dict(values)
  if 'adaptive' in new:
    new['kind'] = ADAPTIVE if new.pop('adaptive') else UNIFORM
  if 'gait_fraction' in new:
    return new
  share, end = new.pop('gait_share', 0.7), new.pop('gait_steps', 0)
  new['gait_fraction'] = (
    {'first': share, 'last': 0.0, 'start': end, 'end': end} if end else 0.0
  )
  share, start = new.pop('focus_share', 0.5), new.pop('focus_start', 0)
  new['focus_end'] = new.pop('focus_steps', 0)
  new['focus_fraction'] = (
    {'first': 0.0, 'last': share, 'start': start, 'end': start}
    if start
    else share
  )
  if not new['focus_end']:  # 0 once stood for never.
    new['focus'] = ''
  return new


def returns_to_probabilities(returns: np.ndarray, epsilon: float) -> np.ndarray:
  """RETURNS2PROB of Algorithm 1: the poorer the return, the likelier.

  Args:
    returns: R, [..., n].
    epsilon: offset after normalisation, at least 0.

  Returns:
    Probabilities along the last axis, [..., n]; uniform when all weights are 0.
  """
  k = -np.asarray(returns, dtype=np.float64)
  k = k - k.min(axis=-1, keepdims=True)
  largest = k.max(axis=-1, keepdims=True)
  k = np.divide(k, largest, out=np.zeros_like(k), where=largest != 0)
  k = k + epsilon
  total = k.sum(axis=-1, keepdims=True)
  uniform = np.full_like(k, 1.0 / k.shape[-1])
  return np.divide(k, total, out=uniform, where=total != 0)


class ModeSampler:
  """Draws pairs (m_i, m_f); adapts to their episodes.

  Attributes:
    initial_returns, final_returns: R_i [n] and R_f [n, n] of Algorithm 1.
    counts: episodes of each pair, and those of them that failed, [2, n, n]; of
      late alone.
  """

  def __init__(self, num_modes: int, config: SamplingConfig):
    """Starts with all returns at 0, as Algorithm 1 does, and no episodes."""
    self._config = config
    self.initial_returns = np.zeros(num_modes)
    self.final_returns = np.zeros((num_modes, num_modes))
    self.counts = np.zeros((2, num_modes, num_modes))

  @property
  def initial_probabilities(self) -> np.ndarray:
    """Probabilities p_i of the initial modes, [n]."""
    if self._config.kind == ADAPTIVE:
      return returns_to_probabilities(
        self.initial_returns, self._config.epsilon
      )
    weights = self._weights().sum(axis=1)
    return weights / weights.sum()

  @property
  def final_probabilities(self) -> np.ndarray:
    """Probabilities p_f, a row of final modes for each initial one, [n, n]."""
    if self._config.kind == ADAPTIVE:
      return returns_to_probabilities(self.final_returns, self._config.epsilon)
    weights = self._weights()
    return weights / weights.sum(axis=1, keepdims=True)

  def _weights(self) -> np.ndarray:
    """Returns what the probabilities of pairs are in proportion to, [n, n]."""
    episodes, failures = self.counts
    if self._config.kind == UNIFORM:
      return np.ones_like(episodes)
    share = (failures + 1) / (episodes + 2)
    return share + np.sqrt(share * (1 - share) / (episodes + 2))

  def sample(
    self, count: int, random_state: np.random.RandomState
  ) -> tuple[np.ndarray, np.ndarray]:
    """Draws initial and final modes, [count] each."""
    initial = _draw(
      np.tile(self.initial_probabilities, (count, 1)), random_state
    )
    return initial, self.sample_final(initial, random_state)

  def sample_final(
    self, initial: np.ndarray, random_state: np.random.RandomState
  ) -> np.ndarray:
    """Draws final modes for initial ones, [count] each."""
    return _draw(self.final_probabilities[initial], random_state)

  def update(
    self,
    initial: np.ndarray,
    final: np.ndarray,
    returns: np.ndarray,
    failed: np.ndarray,
  ) -> None:
    """Adds N finished episodes, one after the other: R <- gamma R + return.

    Args:
      initial, final: their modes, [N].
      returns: normalised, [N].
      failed: whether they terminated early, [N].
    """
    gamma_i, gamma_f = self._config.gamma_initial, self._config.gamma_final
    for i, f, value, fell in zip(initial, final, returns, failed, strict=True):
      self.initial_returns[i] = gamma_i * self.initial_returns[i] + value
      self.final_returns[i, f] = gamma_f * self.final_returns[i, f] + value
      self.counts[:, i, f] *= _FAILURE_MEMORY
      self.counts[:, i, f] += 1, fell

  def state(self) -> dict[str, np.ndarray]:
    """Returns copies of the state for `restore`."""
    return {
      'initial_returns': self.initial_returns.copy(),
      'final_returns': self.final_returns.copy(),
      'counts': self.counts.copy(),
    }

  def restore(self, state: Mapping[str, Any]) -> None:
    """Restores a `state`; raises ValueError for another number of modes."""
    for name in ('initial_returns', 'final_returns', 'counts'):
      if name not in state:  # Earlier versions did not count.
        continue
      value, mine = np.asarray(state[name]), getattr(self, name)
      if value.shape != mine.shape:
        raise ValueError(
          f'The sampler has {name} of shape {mine.shape}, the checkpoint '
          f'{value.shape}: it was made for another mode set.'
        )
      mine[:] = value


def _draw(
  probabilities: np.ndarray, random_state: np.random.RandomState
) -> np.ndarray:
  """Draws one index from each row of probabilities, [B, n] -> [B]."""
  edges = np.cumsum(probabilities, axis=1)
  draws = random_state.uniform(size=(len(probabilities), 1)) * edges[:, -1:]
  return np.sum(draws >= edges[:, :-1], axis=1)
