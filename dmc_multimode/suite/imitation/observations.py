"""Observations of the policy and the value function: pure, batched.

`POLICY_TERMS` and `CRITIC_TERMS` declare every part of the flat observation, in
order: the policy's are [clock (2), command (n_m), state (31)] as in the paper.
Sizes, the layout and the left-right mirror image follow from the declarations.
Orientation and heading-dependent quantities are relative to the commanded
heading, never to the world.

The policy observes neither its distance from the reference nor the next
command, yet both determine the return. A value function that is used in
training alone may observe them (an asymmetric critic, Pinto et al. 2017), which
takes their variance out of the advantages: the privileged critic observations.
"""

import dataclasses
from typing import Any, Callable, Mapping, NamedTuple, TYPE_CHECKING

import numpy as np

from dmc_multimode.utils import arrays

if TYPE_CHECKING:
  from scipy.spatial import transform

NUM_JOINTS = 10
_IDENTITY = (1.0, 0.0, 0.0, 0.0)
_HORIZON = 1.5  # Seconds: the countdown saturates here.
_SIGHT = 1.0  # Metres: the distance to a ledge saturates here.


class PolicyView(NamedTuple):
  """Inputs of the policy's terms; see `policy_view`.

  Attributes:
    qpos: free joint (world position in metres, quaternion), then the joints in
      radians, [B, 17].
    qvel: free joint (world linear velocity in m/s, angular velocity in the
      trunk frame in rad/s), then the joints in rad/s, [B, 16].
    support: height of the support plane under the trunk, metres, [B].
    heading: commanded heading, radians, [B].
    phase: in [0, 1], [B].
    command: latent of the commanded mode, [B, n_m].
    quaternion: of the trunk, (w, x, y, z), finite, [B, 4].
    trunk: the same orientations as rotations, B of them.
  """

  qpos: np.ndarray
  qvel: np.ndarray
  support: np.ndarray
  heading: np.ndarray
  phase: np.ndarray
  command: np.ndarray
  quaternion: np.ndarray
  trunk: 'transform.Rotation'


class CriticView(NamedTuple):
  """Inputs of the critic's terms.

  Attributes:
    position, reference: of the trunk, world metres, [B, 3].
    heading: commanded heading, radians, [B].
    contact: feet on the ground (left, right), 0 or 1, [B, 2].
    countdown: seconds until the next command, infinite without one, [B].
    next_command: latent of the next command, [B, n_m].
    edge: x of the start of the next segment of the ground, world metres,
      infinite without one, [B].
    rise: height of that segment over the support, metres, [B].
    gap: width of the gap before that segment, metres, [B].
  """

  position: np.ndarray
  reference: np.ndarray
  heading: np.ndarray
  contact: np.ndarray
  countdown: np.ndarray
  next_command: np.ndarray
  edge: np.ndarray
  rise: np.ndarray
  gap: np.ndarray


FRAMES: Mapping[str, str] = {
  'world': 'z up, x along the track',
  'heading': 'the world turned by the commanded heading about z',
  'trunk': 'fixed in the trunk: x ahead, y to the left, z up',
}


@dataclasses.dataclass(frozen=True)
class Term:
  """One part of the flat observation.

  Attributes:
    name: key of the part in the observation.
    unit: of its numbers; empty for none.
    function: computes the part from a view, [B, size].
    size: length of the part; None for a latent's n_m. A latent is mirrored to
      that of the mirrored mode.
    signs: of the entries in the left-right mirror image, [size]; 1 if None.
    order: indices of the entries in the mirror image, [size]; itself if None.
    frame: that its vectors are in, one of `FRAMES`; empty for none.
  """

  name: str
  unit: str
  function: Callable[[Any], np.ndarray]
  size: int | None = 1
  signs: tuple[int, ...] | None = None
  order: tuple[int, ...] | None = None
  frame: str = ''


# Equal angles of the two legs, left leg first, are mirror images.
_LEGS_EXCHANGED = (*range(5, NUM_JOINTS), *range(5))
# Reflection in the plane y = 0.
_VECTOR, _AXIAL_VECTOR, _QUATERNION = (1, -1, 1), (-1, 1, -1), (1, -1, 1, -1)

POLICY_TERMS: tuple[Term, ...] = (
  # The mirror image of the clock depends on the mode.
  Term('clock', '', lambda view: clock(view.phase), 2),
  Term('command', '', lambda view: view.command, None),
  Term(
    'height',
    'm',
    lambda view: view.qpos[:, 2:3] - view.support[:, None],
    1,
    frame='world',
  ),
  Term(
    'orientation',
    '',
    lambda view: heading_frame(view.quaternion, view.heading),
    4,
    _QUATERNION,
    frame='heading',
  ),
  Term(
    'joints_pos',
    'rad',
    lambda view: view.qpos[:, 7:],
    NUM_JOINTS,
    order=_LEGS_EXCHANGED,
  ),
  Term(
    'velocity',
    'm/s',
    lambda view: view.trunk.apply(view.qvel[:, :3], inverse=True),
    3,
    _VECTOR,
    frame='trunk',
  ),
  Term(
    'angular_velocity',
    'rad/s',
    lambda view: view.qvel[:, 3:6],
    3,
    _AXIAL_VECTOR,
    frame='trunk',
  ),
  Term(
    'joints_vel',
    'rad/s',
    lambda view: view.qvel[:, 6:],
    NUM_JOINTS,
    order=_LEGS_EXCHANGED,
  ),
)
CRITIC_TERMS: tuple[Term, ...] = (
  Term(
    'position_error',
    'm',
    lambda view: _in_heading(view.position - view.reference, view.heading),
    3,
    _VECTOR,
    frame='heading',
  ),
  Term('contact', '', lambda view: view.contact, 2, order=(1, 0)),
  Term(
    'countdown', 's', lambda view: np.minimum(view.countdown, _HORIZON)[:, None]
  ),
  Term('next_command', '', lambda view: view.next_command, None),
  Term('ground_ahead', 'm', lambda view: _ground_ahead(view), 3),
)


def terms(privileged: bool = False) -> tuple[Term, ...]:
  """Returns the policy's terms, followed by the critic's if `privileged`."""
  return POLICY_TERMS + CRITIC_TERMS if privileged else POLICY_TERMS


def layout(
  latent_dim: int, privileged: bool = False
) -> tuple[tuple[str, int], ...]:
  """Returns (name, size) of every part of the flat observation, in order."""
  return tuple(
    (term.name, latent_dim if term.size is None else term.size)
    for term in terms(privileged)
  )


def size(latent_dim: int, privileged: bool = False) -> int:
  """Returns the length D of the flat observation."""
  return sum(length for _, length in layout(latent_dim, privileged))


def part(name: str, latent_dim: int) -> slice:
  """Returns the place of a part in flat observations."""
  start = 0
  for other, length in layout(latent_dim, privileged=True):
    if other == name:
      return slice(start, start + length)
    start += length
  raise ValueError(f'{name!r} is not a part of the observation.')


def mirror(
  latent_dim: int, privileged: bool = False
) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
  """Returns the left-right mirror image x'[i] = signs[i] * x[order[i]].

  Args:
    latent_dim: n_m.
    privileged: with the critic's terms.

  Returns:
    The order [D] and the signs, float32 [D], of flat observations, and the
    start indices of the latents, which are mirrored by their modes.
  """
  orders, signs, latents, start = [], [], [], 0
  for term, (_, length) in zip(
    terms(privileged), layout(latent_dim, privileged), strict=True
  ):
    orders.append(start + np.asarray(term.order or range(length)))
    signs.append(np.array(term.signs or (1,) * length, dtype=np.float32))
    latents += [start] if term.size is None else []
    start += length
  return np.concatenate(orders), np.concatenate(signs), tuple(latents)


def clock(phase: np.ndarray) -> np.ndarray:
  """Returns [sin 2 pi phase, cos 2 pi phase], [B, 2]."""
  angle = 2 * np.pi * phase
  return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def heading_frame(quaternion: np.ndarray, heading: np.ndarray) -> np.ndarray:
  """Expresses world orientations in frames turned by `heading` about z.

  Args:
    quaternion: (w, x, y, z), [B, 4].
    heading: radians, [B].

  Returns:
    Unit quaternions with w >= 0, [B, 4].
  """
  c, s = np.cos(heading / 2), np.sin(heading / 2)
  # Contiguous arrays are much faster here.
  w, x, y, z = np.ascontiguousarray(quaternion.T)
  # The product of the inverse heading (c, 0, 0, -s) and the quaternion.
  turned = np.stack(
    [c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w]
  )
  turned /= np.linalg.norm(turned, axis=0)
  turned *= np.where(turned[0] < 0, -1.0, 1.0)
  return np.ascontiguousarray(turned.T)


def policy_view(
  qpos: np.ndarray,
  qvel: np.ndarray,
  support: np.ndarray,
  heading: np.ndarray,
  phase: np.ndarray,
  command: np.ndarray,
) -> PolicyView:
  """Returns the inputs of the policy's terms; see `PolicyView`."""
  from scipy.spatial import transform  # Late: scipy imports slowly.

  # A world that diverged has no orientation; identity keeps the others going.
  quaternion = np.where(
    arrays.finite_rows(qpos[:, 3:7])[:, None], qpos[:, 3:7], _IDENTITY
  )
  trunk = transform.Rotation.from_quat(quaternion, scalar_first=True)
  return PolicyView(
    qpos, qvel, support, heading, phase, command, quaternion, trunk
  )


def observe(view: PolicyView) -> dict[str, np.ndarray]:
  """Returns the policy's parts by name, in the order of `layout`."""
  return {term.name: term.function(view) for term in POLICY_TERMS}


def observe_privileged(view: CriticView) -> dict[str, np.ndarray]:
  """Returns the critic's parts by name, in the order of `layout`."""
  return {term.name: term.function(view) for term in CRITIC_TERMS}


def flatten(parts: Mapping[str, np.ndarray]) -> np.ndarray:
  """Concatenates the parts to float32 vectors, [B, D]."""
  return np.concatenate(list(parts.values()), axis=-1, dtype=np.float32)


def _in_heading(vectors: np.ndarray, heading: np.ndarray) -> np.ndarray:
  """Expresses world vectors [B, 3] in frames turned by `heading` about z."""
  x, y, z = vectors.T
  c, s = np.cos(heading), np.sin(heading)
  return np.stack([c * x + s * y, c * y - s * x, z], axis=-1)


def _ground_ahead(view: CriticView) -> np.ndarray:
  """Returns distance, rise and gap of a near ledge, metres, [B, 3]."""
  distance = view.edge - view.position[:, 0]
  near = distance < _SIGHT
  parts = np.minimum(distance, _SIGHT), near * view.rise, near * view.gap
  return np.stack(parts, axis=-1)
