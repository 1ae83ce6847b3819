"""Exchange of a robot's left and right: by names, verified on its model."""

import re
from typing import Iterator, NamedTuple, Sequence

import mujoco
import numpy as np

_STATES, _TOLERANCE = 8, 1e-6  # Of the comparison of accelerations.
_SPREAD = 0.2  # Share of the ranges around the standing pose that is compared.
_APART = 1e-3  # Metres that mirrored feet may be apart.
_SAME_AXIS = 1e-3
# Reflection in the plane y = 0 of vectors, and of axial vectors.
_VECTOR, _AXIAL = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])
_SWAPPED = {'l': 'r', 'r': 'l', 'L': 'R', 'R': 'L'}
_SIDE = re.compile('left|right|Left|Right|LEFT|RIGHT')
_WORD = re.compile('[A-Za-z]+')
_LONGEST = (
  2  # Letters of a word such as l, R, fl or RH, one of which is a side.
)


class Mirror(NamedTuple):
  """Mirror image x'[i] = signs[i] * x[order[i]] of joints, and of feet.

  Attributes:
    joint_order, joint_signs: of angles, speeds and actions, [J].
    foot_order: of contacts, [F].
    pairs: indices of the feet (left, right) that change places.
    asymmetry: greatest difference of an acceleration from that of its mirror
      image, in the greatest acceleration of the same state.
  """

  joint_order: tuple[int, ...]
  joint_signs: tuple[int, ...]
  foot_order: tuple[int, ...]
  pairs: tuple[tuple[int, int], ...]
  asymmetry: float


def derive(
  model: mujoco.MjModel,
  qpos: np.ndarray,
  joints: Sequence[str],
  feet: Sequence[str],
  sites: np.ndarray,
  allowed: float = 0.0,
) -> Mirror:
  """Returns a robot's mirror image.

  Args:
    model: compiled, with nothing but the robot.
    qpos: of the standing pose, [7 + J].
    joints, feet: names.
    sites: indices of the feet's sites, [F].
    allowed: asymmetry that a real robot may have, whose masses are measured.

  Raises:
    ValueError: in one line, what has no mirror image.
  """
  data = mujoco.MjData(model)
  data.qpos[:] = qpos
  mujoco.mj_forward(model, data)
  order = exchanged(joints, 'joint')
  signs = _signs(model, data, joints, order)
  foot_order = exchanged(feet, 'foot')
  places = data.site_xpos[sites]
  pairs = []
  for i, j in enumerate(foot_order):
    if i == j:
      raise ValueError(f'the foot {feet[i]!r} has no mirror image.')
    if np.linalg.norm(places[j] - _VECTOR * places[i]) > _APART:
      raise ValueError(
        f'the feet {feet[i]!r} and {feet[j]!r} are not where each is the '
        "other's mirror image in the standing pose."
      )
    if i < j:
      if places[i, 1] <= places[j, 1]:
        raise ValueError(f'feet: give {feet[j]!r}, the left one, first.')
      if j != i + 1:
        raise ValueError(
          f'feet: give {feet[j]!r} right after {feet[i]!r}, its other side: '
          'front left, front right, hind left, hind right.'
        )
      pairs.append((i, j))
  ahead = [places[i, 0] for i, _ in pairs]
  if ahead != sorted(ahead, reverse=True):
    raise ValueError('feet: give the front feet first.')
  mirror = Mirror(order, signs, foot_order, tuple(pairs), 0.0)
  found, where = _asymmetry(model, qpos, mirror)
  if found > max(allowed, _TOLERANCE):
    name = repr(joints[where - 6]) if where >= 6 else 'the trunk'
    raise ValueError(
      f'left and right differ: {name} moves otherwise than its mirror image '
      f'by {found:.2g} of the acceleration (masses, inertias, ranges, servos): '
      'correct the model, or declare an asymmetry above this.'
    )
  return mirror._replace(asymmetry=found)


def exchanged(names: Sequence[str], kind: str) -> tuple[int, ...]:
  """Returns the index of each name's partner; its own in the middle.

  Args:
    names: such as left_knee, L_knee or FL_knee for the left.
    kind: of what is named, for errors.

  Raises:
    ValueError: a name of a side has no partner.
  """
  order = []
  for name in names:
    partners = [other for other in _candidates(name) if other in names]
    if len(set(partners)) > 1:
      raise ValueError(
        f'the {kind} {name!r} could be mirrored by {partners[0]!r} or '
        f'{partners[1]!r}: say left and right in their names.'
      )
    if not partners and _SIDE.search(name):
      raise ValueError(
        f'the {kind} {name!r} has no mirror image: there is no '
        f'{next(_candidates(name))!r}.'
      )
    order.append(list(names).index(partners[0] if partners else name))
  if any(order[j] != i for i, j in enumerate(order)):
    raise ValueError(f'the names of the {kind}s do not pair left and right.')
  return tuple(order)


def _candidates(name: str) -> Iterator[str]:
  """Yields the names that a partner may have."""
  for side in _SIDE.finditer(name):
    text = side.group()
    other = {'left': 'right', 'right': 'left'}[text.lower()]
    if text[0].isupper():
      other = other.upper() if text.isupper() else other.capitalize()
    yield name[: side.start()] + other + name[side.end() :]
  for word in _WORD.finditer(name):
    if len(word.group()) <= _LONGEST:
      for i in range(word.start(), word.end()):
        if name[i] in _SWAPPED:
          yield name[:i] + _SWAPPED[name[i]] + name[i + 1 :]


def _signs(
  model: mujoco.MjModel,
  data: mujoco.MjData,
  joints: Sequence[str],
  order: Sequence[int],
) -> tuple[int, ...]:
  """Returns the signs of the joints, by their axes in the standing pose."""
  signs = []
  hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
  first = model.njnt - len(joints)  # After the free joint.
  for i, j in enumerate(order):
    one, other = data.xaxis[first + i], data.xaxis[first + j]
    is_hinge = model.jnt_type[first + i] == hinge
    mirrored = (_AXIAL if is_hinge else _VECTOR) * one
    sign = 1 if other @ mirrored > 0 else -1
    if np.linalg.norm(sign * other - mirrored) > _SAME_AXIS:
      if i == j:
        raise ValueError(
          f'the joint {joints[i]!r} has no partner by its name, and is not its '
          'own mirror image.'
        )
      raise ValueError(
        f'the joints {joints[i]!r} and {joints[j]!r} have axes that are not '
        "each other's mirror image in the standing pose."
      )
    signs.append(sign)
  return tuple(signs)


def _asymmetry(
  model: mujoco.MjModel, qpos: np.ndarray, mirror: Mirror
) -> tuple[float, int]:
  """Returns the asymmetry, and the coordinate [6 + J] that has it.

  Mirrored states should move as each other's image. In the air, about the
  standing pose and some of it beyond the joints' limits: masses, inertias,
  ranges, servos and friction have to agree.
  """
  order = np.array(mirror.joint_order)
  signs = np.array(mirror.joint_signs)
  image = lambda values: np.concatenate(
    [_VECTOR * values[:3], _AXIAL * values[3:6], signs * values[6:][order]]
  )
  random, count = np.random.RandomState(0), len(order)
  low, high = model.jnt_range[-count:].T
  found = (0.0, 0)
  for state in range(_STATES):
    spread = _SPREAD * (high - low) * random.uniform(-1, 1, count)
    pose = qpos[7:] + spread
    if state == 0:  # Everything beyond its limits.
      pose = np.where(random.uniform(size=count) < 0.5, low, high)
      pose = pose + spread / 10
    speed = random.standard_normal(6 + count)
    action = pose + 0.1 * random.standard_normal(count)
    mine = _acceleration(model, pose, speed, action)
    other = _acceleration(
      model, signs * pose[order], image(speed), signs * action[order]
    )
    off = np.abs(image(other) - mine) / np.abs(mine).max()
    found = max(found, (float(off.max()), int(np.argmax(off))))
  return found


def _acceleration(
  model: mujoco.MjModel,
  pose: np.ndarray,
  speed: np.ndarray,
  action: np.ndarray,
) -> np.ndarray:
  """Returns accelerations in the air, upright at the origin, [6 + J]."""
  data = mujoco.MjData(model)
  data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
  data.qpos[7:], data.qvel[:], data.ctrl[:] = pose, speed, action
  flags = model.opt.disableflags
  # Bodies of a robot may touch each other in what is no pose of a gait.
  model.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
  mujoco.mj_forward(model, data)
  model.opt.disableflags = flags
  return data.qacc.copy()
