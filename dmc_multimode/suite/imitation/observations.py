"""Observations of the policy and the value function: pure, batched.

`PAPER_TERMS`, `EXTRA_TERMS` and `CRITIC_TERMS` declare every part of the flat
observation, in order: [clock (2), command (n_m), state (31)] as in the paper;
those of `EXTRA_TERMS` that the task's configuration names; and, in training
alone, what the value function observes besides. Sizes, the layout, the
left-right mirror image and the sensor noise follow from the declarations, and
from the robot, by default the mini biped.
Orientation and heading-dependent quantities are relative to the commanded
heading, never to the world.

With the paper's terms the policy observes neither its distance from the
reference nor the next command, yet both determine the return. A value function
that is used in training alone may observe them (an asymmetric critic, Pinto et
al. 2017), which takes their variance out of the advantages: the privileged
critic observations.
"""

import dataclasses
import enum
from typing import (
  Any,
  Callable,
  Iterable,
  Mapping,
  NamedTuple,
  TYPE_CHECKING,
)

import numpy as np

from dmc_multimode.utils import arrays
from dmc_multimode.walkers import robot as robot_lib

if TYPE_CHECKING:
  from scipy.spatial import transform

_IDENTITY = (1.0, 0.0, 0.0, 0.0)
_HORIZON = 1.5  # Seconds: the countdown saturates here.
_SIGHT = 1.0  # Metres: the distance to a ledge saturates here.
_ASTRAY = 0.5  # Metres: the displacement saturates here.
# Metres ahead of the trunk, along the commanded heading, of the ground's scan.
SCAN = tuple(round(0.09 * i - 0.18, 2) for i in range(16))
SCAN_AGE = 0.03  # Seconds from a scan of the ground to its use.
_DEEP = 0.6  # Metres: the scan saturates here.
# Rows of `Disturbances` that act on the robot; none changes in a mirror.
_FELT_DISTURBANCES = (
  'action_delay',
  'friction',
  'mass',
  'payload',
  'centre_of_mass',
  'motor_strength',
  'slope',
)


class PolicyView(NamedTuple):
  """Inputs of the policy's terms; see `policy_view`.

  Attributes:
    qpos: free joint (world position in metres, quaternion), then the joints in
      radians, [B, 7 + J].
    qvel: free joint (world linear velocity in m/s, angular velocity in the
      trunk frame in rad/s), then the joints in rad/s, [B, 6 + J].
    support: height of the support plane under the trunk, metres, [B].
    heading: commanded heading, radians, [B].
    phase: in [0, 1], [B].
    command: latent of the commanded mode, [B, n_m].
    displacement: of the trunk from the reference, x and y, world metres,
      [B, 2].
    clock_rate: rate of the phase clock, 1 being the reference's own, [B].
    actions: last joint targets, the newest first, radians, [B, H, J].
    ground: heights of the ground at `SCAN` over the support plane, as it was
      `SCAN_AGE` ago, metres, [B, 16]; minus infinity where there is none.
    quaternion: of the trunk, (w, x, y, z), finite, [B, 4].
    trunk: the same orientations as rotations, B of them.
  """

  qpos: np.ndarray
  qvel: np.ndarray
  support: np.ndarray
  heading: np.ndarray
  phase: np.ndarray
  command: np.ndarray
  displacement: np.ndarray
  clock_rate: np.ndarray
  actions: np.ndarray
  ground: np.ndarray
  quaternion: np.ndarray
  trunk: 'transform.Rotation'


class CriticView(NamedTuple):
  """Inputs of the critic's terms.

  Attributes:
    position, reference: of the trunk, world metres, [B, 3].
    heading: commanded heading, radians, [B].
    contact: feet on the ground, in the robot's order, 0 or 1, [B, F].
    countdown: seconds until the next command, infinite without one, [B].
    next_command: latent of the next command, [B, n_m].
    edge: x of the start of the next segment of the ground, world metres,
      infinite without one, [B].
    rise: height of that segment over the support, metres, [B].
    gap: width of the gap before that segment, metres, [B].
    disturbances: values by row of `Disturbances`, [B] each.
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
  disturbances: Mapping[str, np.ndarray]


FRAMES: Mapping[str, str] = {
  'world': 'z up, x along the track',
  'heading': 'the world turned by the commanded heading about z',
  'trunk': 'fixed in the trunk: x ahead, y to the left, z up',
}


class Per(enum.Enum):
  """Things of which a part has one number each."""

  LATENT = 'latent'  # Mirrored to the latent of the mirrored mode.
  JOINT = 'joint'
  FOOT = 'foot'


@dataclasses.dataclass(frozen=True)
class Term:
  """One part of the flat observation.

  Attributes:
    name: key of the part in the observation.
    unit: of its numbers; empty for none.
    function: computes the part from a view, [B, size].
    size: length of the part, or what it has a number of, whose mirror image is
      that of the robot.
    signs: of the entries in the left-right mirror image, [size]; 1 if None.
    frame: that its vectors are in, one of `FRAMES`; empty for none.
    noise: standard deviation of the sensor noise that `sensor_noise` of 1
      means, in the unit.
    dropouts: share of the entries that a sensor then misses, and reads as 0.
  """

  name: str
  unit: str
  function: Callable[[Any], np.ndarray]
  size: int | Per = 1
  signs: tuple[int, ...] | None = None
  frame: str = ''
  noise: float = 0.0
  dropouts: float = 0.0


# Reflection in the plane y = 0.
_VECTOR, _AXIAL_VECTOR, _QUATERNION = (1, -1, 1), (-1, 1, -1), (1, -1, 1, -1)

PAPER_TERMS: tuple[Term, ...] = (
  # The mirror image of the clock depends on the mode.
  Term('clock', '', lambda view: clock(view.phase), 2),
  Term('command', '', lambda view: view.command, Per.LATENT),
  Term(
    'height',
    'm',
    lambda view: view.qpos[:, 2:3] - view.support[:, None],
    frame='world',
    noise=0.01,
  ),
  Term(
    'orientation',
    '',
    lambda view: heading_frame(view.quaternion, view.heading),
    4,
    _QUATERNION,
    frame='heading',
    noise=0.005,
  ),
  Term(
    'joints_pos',
    'rad',
    lambda view: view.qpos[:, 7:],
    Per.JOINT,
    noise=0.01,
  ),
  Term(
    'velocity',
    'm/s',
    lambda view: view.trunk.apply(view.qvel[:, :3], inverse=True),
    3,
    _VECTOR,
    frame='trunk',
    noise=0.05,
  ),
  Term(
    'angular_velocity',
    'rad/s',
    lambda view: view.qvel[:, 3:6],
    3,
    _AXIAL_VECTOR,
    frame='trunk',
    noise=0.1,
  ),
  Term(
    'joints_vel',
    'rad/s',
    lambda view: view.qvel[:, 6:],
    Per.JOINT,
    noise=0.1,
  ),
)
EXTRA_TERMS: tuple[Term, ...] = (
  # On a robot: odometry since the command.
  Term(
    'displacement',
    'm',
    lambda view: np.clip(
      in_heading(view.displacement, view.heading), -_ASTRAY, _ASTRAY
    ),
    2,
    (1, -1),
    frame='heading',
    noise=0.01,
  ),
  Term('clock_rate', '', lambda view: view.clock_rate[:, None]),
  Term(
    'previous_action',
    'rad',
    lambda view: view.actions[:, 0],
    Per.JOINT,
  ),
  # On a robot: from a depth camera or a map.
  Term(
    'ground_scan',
    'm',
    lambda view: np.clip(view.ground, -_DEEP, _DEEP),
    len(SCAN),
    frame='heading',
    noise=0.02,
    dropouts=0.02,
  ),
)
EXTRA_NAMES = tuple(term.name for term in EXTRA_TERMS)
CRITIC_TERMS: tuple[Term, ...] = (
  Term(
    'position_error',
    'm',
    lambda view: in_heading(view.position - view.reference, view.heading),
    3,
    _VECTOR,
    frame='heading',
  ),
  Term('contact', '', lambda view: view.contact, Per.FOOT),
  Term(
    'countdown', 's', lambda view: np.minimum(view.countdown, _HORIZON)[:, None]
  ),
  Term('next_command', '', lambda view: view.next_command, Per.LATENT),
  Term('ground_ahead', 'm', lambda view: _ground_ahead(view), 3),
)
# The critic's, in trainings that draw them.
DISTURBANCES = Term(
  'disturbances',
  '',
  lambda view: np.stack(
    [view.disturbances[name] for name in _FELT_DISTURBANCES], axis=-1
  ),
  len(_FELT_DISTURBANCES),
)


def terms(
  privileged: bool = False, extra: Iterable[str] = ()
) -> tuple[Term, ...]:
  """Returns the terms of an observation, in order.

  Args:
    privileged: with the critic's terms.
    extra: names of the terms beyond the paper's, of `EXTRA_TERMS`; with that of
      `DISTURBANCES` the critic observes these.
  """
  chosen = tuple(extra)
  more = tuple(term for term in EXTRA_TERMS if term.name in chosen)
  return PAPER_TERMS + more + (critic_terms(chosen) if privileged else ())


def check_extra(names: Iterable[str]) -> None:
  """Raises ValueError unless all names are of `EXTRA_TERMS`."""
  for name in names:
    if name not in EXTRA_NAMES:
      raise ValueError(
        f'unknown observation {name!r:.50}; there are {", ".join(EXTRA_NAMES)}'
      )


def critic_terms(extra: Iterable[str] = ()) -> tuple[Term, ...]:
  """Returns the terms of the critic alone, in order; see `terms`."""
  return CRITIC_TERMS + (DISTURBANCES,) * (DISTURBANCES.name in extra)


def layout(
  latent_dim: int,
  privileged: bool = False,
  extra: Iterable[str] = (),
  robot: robot_lib.Robot | None = None,
) -> tuple[tuple[str, int], ...]:
  """Returns (name, size) of every part of the flat observation, in order.

  Args:
    latent_dim: n_m.
    privileged: with the critic's terms.
    extra: names of the terms beyond the paper's.
    robot: the mini biped by default.
  """
  robot = robot_lib.find(robot)
  counts = {
    Per.LATENT: latent_dim,
    Per.JOINT: robot.num_joints,
    Per.FOOT: robot.num_feet,
  }
  return tuple(
    (term.name, counts[term.size] if isinstance(term.size, Per) else term.size)
    for term in terms(privileged, extra)
  )


def size(
  latent_dim: int,
  privileged: bool = False,
  extra: Iterable[str] = (),
  robot: robot_lib.Robot | None = None,
) -> int:
  """Returns the length D of the flat observation; see `layout`."""
  parts = layout(latent_dim, privileged, extra, robot)
  return sum(length for _, length in parts)


def part(
  name: str,
  latent_dim: int,
  privileged: bool = True,
  extra: Iterable[str] = (),
  robot: robot_lib.Robot | None = None,
) -> slice:
  """Returns the place of a part in flat observations; see `layout`."""
  return place(name, layout(latent_dim, privileged, extra, robot))


def place(name: str, parts: Iterable[tuple[str, int]]) -> slice:
  """Returns the place of a part among parts of given names and sizes.

  Raises:
    ValueError: there is no such part.
  """
  start = 0
  for other, length in parts:
    if other == name:
      return slice(start, start + length)
    start += length
  raise ValueError(f'{name!r} is not a part of the observation.')


class SensorErrors:
  """Errors of the policy's observations."""

  def __init__(
    self,
    latent_dim: int,
    extra: Iterable[str] = (),
    robot: robot_lib.Robot | None = None,
  ):
    """Declares the errors of the terms.

    Args:
      latent_dim: n_m.
      extra: names of the terms beyond the paper's.
      robot: that is observed; the mini biped by default.
    """
    chosen = tuple(extra)
    parts = layout(latent_dim, extra=chosen, robot=robot)
    lengths = [length for _, length in parts]
    by_entry = lambda values: np.repeat(values, lengths)
    self.noise = by_entry([term.noise for term in terms(extra=chosen)])
    self._dropouts = by_entry([term.dropouts for term in terms(extra=chosen)])

  def draw(
    self, count: int, scale: float, random_state: np.random.RandomState
  ) -> np.ndarray:
    """Returns errors of observations, NaN where one is missed, [N, D].

    Args:
      count: N.
      scale: factor of the noise and of the share of dropouts.
      random_state: source of the errors.
    """
    shape = count, len(self.noise)
    errors = scale * self.noise * random_state.standard_normal(shape)
    if self._dropouts.any():
      missed = random_state.uniform(size=shape) < scale * self._dropouts
      errors[missed] = np.nan
    return errors


def with_errors(observed: np.ndarray, errors: np.ndarray) -> np.ndarray:
  """Returns observations with their errors; both are [B, D]."""
  return np.where(np.isnan(errors), 0.0, observed + errors)


def mirror(
  latent_dim: int,
  privileged: bool = False,
  extra: Iterable[str] = (),
  robot: robot_lib.Robot | None = None,
) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
  """Returns the left-right mirror image x'[i] = signs[i] * x[order[i]].

  Args:
    latent_dim: n_m.
    privileged: with the critic's terms.
    extra: names of the terms beyond the paper's.
    robot: the mini biped by default.

  Returns:
    The order [D] and the signs, float32 [D], of flat observations, and the
    start indices of the latents, which are mirrored by their modes.
  """
  robot = robot_lib.find(robot)
  body = robot.derived.mirror
  orders, signs, latents, start = [], [], [], 0
  for term, (_, length) in zip(
    terms(privileged, extra),
    layout(latent_dim, privileged, extra, robot),
    strict=True,
  ):
    order, sign = tuple(range(length)), term.signs or (1,) * length
    if term.size is Per.JOINT:
      order, sign = body.joint_order, body.joint_signs
    elif term.size is Per.FOOT:
      order = body.foot_order
    orders.append(start + np.asarray(order))
    signs.append(np.array(sign, dtype=np.float32))
    latents += [start] if term.size is Per.LATENT else []
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
  displacement: np.ndarray,
  clock_rate: np.ndarray,
  actions: np.ndarray,
  ground: np.ndarray,
) -> PolicyView:
  """Returns the inputs of the policy's terms; see `PolicyView`."""
  from scipy.spatial import transform  # Late: scipy imports slowly.

  # A world that diverged has no orientation; identity keeps the others going.
  quaternion = np.where(
    arrays.finite_rows(qpos[:, 3:7])[:, None], qpos[:, 3:7], _IDENTITY
  )
  trunk = transform.Rotation.from_quat(quaternion, scalar_first=True)
  return PolicyView(
    qpos,
    qvel,
    support,
    heading,
    phase,
    command,
    displacement,
    clock_rate,
    actions,
    ground,
    quaternion,
    trunk,
  )


def observe(
  view: PolicyView, extra: Iterable[str] = ()
) -> dict[str, np.ndarray]:
  """Returns the policy's parts by name, in the order of `layout`."""
  return {term.name: term.function(view) for term in terms(extra=extra)}


def observe_privileged(
  view: CriticView, extra: Iterable[str] = ()
) -> dict[str, np.ndarray]:
  """Returns the critic's parts by name, in the order of `layout`."""
  return {term.name: term.function(view) for term in critic_terms(extra)}


def flatten(parts: Mapping[str, np.ndarray]) -> np.ndarray:
  """Concatenates the parts to float32 vectors, [B, D]."""
  return np.concatenate(list(parts.values()), axis=-1, dtype=np.float32)


def in_heading(vectors: np.ndarray, heading: np.ndarray) -> np.ndarray:
  """Expresses world vectors [B, 2 or 3] in frames turned by `heading`."""
  x, y, *z = vectors.T
  c, s = np.cos(heading), np.sin(heading)
  return np.stack([c * x + s * y, c * y - s * x, *z], axis=-1)


def _ground_ahead(view: CriticView) -> np.ndarray:
  """Returns distance, rise and gap of a near ledge, metres, [B, 3]."""
  distance = view.edge - view.position[:, 0]
  near = distance < _SIGHT
  parts = np.minimum(distance, _SIGHT), near * view.rise, near * view.gap
  return np.stack(parts, axis=-1)
