"""Library of named modes, and the paper's mode sets."""

import dataclasses
import functools
import os
from typing import Iterable, Mapping, Sequence

import numpy as np

from dmc_multimode.modes import codebook as codebook_lib
from dmc_multimode.modes import mode_set as mode_set_lib
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.utils import constants
from dmc_multimode.utils import resources

_FILES = '.yaml', '.yml', '.json'  # Mode files end so, and no name does.
_WALK_DURATION = 0.6  # Seconds of a stride, one step of each foot.
# Phases of a stride: both feet stand for a tenth of it.
_STEP_PHASES = np.array([0.0, 0.025, 0.475, 0.525, 0.975, 1.0])
_WALK_SPEEDS = {  # m/s; forward covers the 2 m of Table III in 3.3 s.
  'forward': 0.6,
  'backward': 0.4,
  'left': 0.3,
  'right': 0.3,
}
_LEAP_DURATION = 1.2  # Seconds: crouch, flight, landing.
_LEAP_LENGTHS = {  # Metres a cycle.
  'forward': 0.6,
  'backward': 0.4,
  'left': 0.3,
  'right': 0.3,
}
_FAR_LENGTH = 0.9  # Likewise, of a leap across a gap of 0.55 m.
_DIRECTIONS = {
  'forward': (1.0, 0.0),
  'backward': (-1.0, 0.0),
  'left': (0.0, 1.0),
  'right': (0.0, -1.0),
}
_TROT_SPEED = 0.8  # m/s; four feet are steadier.
_BOUND_SPEED, _BOUND_DURATION = 1.0, 0.4  # A slower one would pitch too far.
# Hind feet stand, then front feet, each for two fifths of the cycle.
_BOUND_PHASES = np.array([0.0, 0.4, 0.5, 0.9, 1.0])
_TURN = 0.35  # Radians a stride: 33 degrees a second.
_MIRRORED = {'left': 'right', 'right': 'left'}

# Rough, yet near what gravity allows: 0.34 s of flight between take-off and
# touch-down, in which more than half of the way is covered.
_LEAP_PHASES = (0.0, 0.25, 0.42, 0.56, 0.70, 0.83, 1.0)
_LEAP_PROGRESS = (0.0, 0.07, 0.23, 0.50, 0.77, 0.92, 1.0)
_LEAP_HEIGHTS = (0.50, 0.43, 0.57, 0.68, 0.57, 0.45, 0.50)

_LAUNCH_LEDGE = motion_lib.Ledge(edge=0.27, height=0.4)
_LAUNCH_DURATION = 1.1  # Seconds.
_LAUNCH_PHASES = (0.0, 0.25, 0.42, 0.55, 0.67, 0.82, 1.0)
_LAUNCH_X = (0.0, 0.02, 0.11, 0.26, 0.43, 0.56, 0.60)
_LAUNCH_Z = (0.50, 0.40, 0.62, 0.90, 1.02, 0.88, 0.90)
_LAUNCH_TAKEOFF, _LAUNCH_TOUCHDOWN = 0.42, 0.82

# Reverse of a launch: a crouch over the edge, a fall of 0.33 s, a deep landing.
_DESCENT_LEDGE = motion_lib.Ledge(edge=0.2, height=-0.4)
_DESCENT_DURATION = 1.0  # Seconds.
_DESCENT_PHASES = (0.0, 0.20, 0.38, 0.55, 0.71, 0.84, 1.0)
_DESCENT_X = (0.0, 0.02, 0.12, 0.29, 0.45, 0.53, 0.55)
_DESCENT_Z = (0.50, 0.45, 0.53, 0.47, 0.16, 0.02, 0.10)
_DESCENT_TAKEOFF, _DESCENT_TOUCHDOWN = 0.38, 0.71


def _upright(count: int) -> np.ndarray:
  return np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))


def _idle() -> motion_lib.ReferenceMotion:
  return motion_lib.ReferenceMotion(
    name='idle',
    kind=motion_lib.STEADY,
    duration=_WALK_DURATION,
    phases=np.array([0.0, 1.0]),
    positions=np.tile([0.0, 0.0, constants.STAND_HEIGHT], (2, 1)),
    orientations=_upright(2),
    contacts=np.ones((2, 2)),
    half_cycle_symmetric=True,
  )


def _level(
  name: str,
  direction: str,
  phases: np.ndarray,
  contacts: np.ndarray,
  in_sync: bool,
) -> motion_lib.ReferenceMotion:
  """Returns a motion of constant height and speed, such as walk and hop."""
  distance = _WALK_SPEEDS[direction] * _WALK_DURATION
  end = np.append(
    distance * np.array(_DIRECTIONS[direction]), constants.STAND_HEIGHT
  )
  start = np.array([0.0, 0.0, constants.STAND_HEIGHT])
  return motion_lib.ReferenceMotion(
    name=f'{name}_{direction}',
    kind=motion_lib.PERIODIC,
    duration=_WALK_DURATION,
    phases=phases,
    positions=start + phases[:, None] * (end - start),
    orientations=_upright(len(phases)),
    contacts=contacts,
    mirror=f'{name}_{_MIRRORED.get(direction, direction)}',
    half_cycle_symmetric=not in_sync,
  )


def _walk(direction: str) -> motion_lib.ReferenceMotion:
  # Left, then right stance.
  contacts = _stepping((1, 0), (0, 1))
  return _level('walk', direction, _STEP_PHASES, contacts, in_sync=False)


def _stepping(first: Sequence[int], second: Sequence[int]) -> np.ndarray:
  """Returns contacts at `_STEP_PHASES`: two stances, and both feet between."""
  both = (1, 1)
  return np.array([both, first, both, second, both, both])


def _hop(direction: str) -> motion_lib.ReferenceMotion:
  contacts = np.array([[1, 1], [1, 1], [0, 0], [0, 0]])  # Flight: a third.
  phases = np.linspace(0.0, 1.0, len(contacts))
  return _level('hop', direction, phases, contacts, in_sync=True)


def _leap(
  direction: str, length: float | None = None
) -> motion_lib.ReferenceMotion:
  length = length or _LEAP_LENGTHS[direction]
  path = np.outer(_LEAP_PROGRESS, np.array(_DIRECTIONS[direction]) * length)
  flight = (np.array(_LEAP_PHASES) >= 0.42) & (np.array(_LEAP_PHASES) < 0.70)
  return motion_lib.ReferenceMotion(
    name=f'leap_{direction}',
    kind=motion_lib.PERIODIC,
    duration=_LEAP_DURATION,
    phases=np.array(_LEAP_PHASES),
    positions=np.column_stack([path, _LEAP_HEIGHTS]),
    orientations=_upright(len(_LEAP_PHASES)),
    contacts=np.repeat(~flight[:, None], 2, axis=1),
    mirror=f'leap_{_MIRRORED.get(direction, direction)}',
  )


def _turn(side: str) -> motion_lib.ReferenceMotion:
  """Returns a turn on the spot, the inner foot first."""
  sign = {'left': 1.0, 'right': -1.0}[side]
  halves = sign * _TURN * _STEP_PHASES / 2
  zeros = np.zeros(len(halves))
  contacts = _stepping((0, 1), (1, 0))
  return motion_lib.ReferenceMotion(
    name=f'turn_{side}',
    kind=motion_lib.PERIODIC,
    duration=_WALK_DURATION,
    phases=_STEP_PHASES,
    positions=np.tile(
      [0.0, 0.0, constants.STAND_HEIGHT], (len(_STEP_PHASES), 1)
    ),
    orientations=np.stack([np.cos(halves), zeros, zeros, np.sin(halves)], 1),
    contacts=contacts if side == 'left' else contacts[:, ::-1],
    mirror=f'turn_{_MIRRORED[side]}',
  )


def _jump(
  name: str,
  duration: float,
  phases: Sequence[float],
  x: Sequence[float],
  z: Sequence[float],
  ledge: motion_lib.Ledge,
  flight: tuple[float, float],
) -> motion_lib.ReferenceMotion:
  """Returns a jump to another height, with phases of the `flight`."""
  moments = np.array(phases)
  flying = (moments >= flight[0]) & (moments < flight[1])
  return motion_lib.ReferenceMotion(
    name=name,
    kind=motion_lib.TRANSIENT,
    duration=duration,
    phases=moments,
    positions=np.column_stack([x, np.zeros(len(moments)), z]),
    orientations=_upright(len(moments)),
    contacts=np.repeat(~flying[:, None], 2, axis=1),
    ledge=ledge,
    takeoff=flight[0],
  )


def _launch() -> motion_lib.ReferenceMotion:
  return _jump(
    'launch',
    _LAUNCH_DURATION,
    _LAUNCH_PHASES,
    _LAUNCH_X,
    _LAUNCH_Z,
    _LAUNCH_LEDGE,
    (_LAUNCH_TAKEOFF, _LAUNCH_TOUCHDOWN),
  )


def _descent() -> motion_lib.ReferenceMotion:
  return _jump(
    'step_down',
    _DESCENT_DURATION,
    _DESCENT_PHASES,
    _DESCENT_X,
    _DESCENT_Z,
    _DESCENT_LEDGE,
    (_DESCENT_TAKEOFF, _DESCENT_TOUCHDOWN),
  )


def _on_four_feet(
  motion: motion_lib.ReferenceMotion, name: str
) -> motion_lib.ReferenceMotion:
  """Returns a motion whose feet move together, for four of them."""
  assert motion.contacts is not None
  return dataclasses.replace(
    motion,
    name=name,
    mirror=name,
    contacts=np.repeat(motion.contacts[:, :1], 4, axis=1),
  )


def _four_footed_gait(
  name: str,
  speed: float,
  duration: float,
  phases: np.ndarray,
  contacts: np.ndarray,
  in_sync: bool = False,
) -> motion_lib.ReferenceMotion:
  """Returns a gait of constant height and speed, m/s, straight ahead."""
  start = np.array([0.0, 0.0, constants.STAND_HEIGHT])
  way = np.array([speed * duration, 0.0, 0.0])
  return motion_lib.ReferenceMotion(
    name=f'{name}_forward',
    kind=motion_lib.PERIODIC,
    duration=duration,
    phases=phases,
    positions=start + phases[:, None] * way,
    orientations=_upright(len(phases)),
    contacts=contacts,
    half_cycle_symmetric=not in_sync,
  )


@functools.cache
def four_footed_modes() -> Mapping[str, motion_lib.ReferenceMotion]:
  """Returns the modes of four feet by name; they have no shipped latents.

  Contacts are of the feet (front left, front right, hind left, hind right).
  """
  every = (1, 1, 1, 1)
  stepping = lambda first, second: np.array(
    [every, first, every, second, every, every]
  )
  hind, front, none = (0, 0, 1, 1), (1, 1, 0, 0), (0, 0, 0, 0)
  motions = [
    _on_four_feet(_idle(), 'stand'),
    _four_footed_gait(
      'trot',
      _TROT_SPEED,
      _WALK_DURATION,
      _STEP_PHASES,
      stepping((1, 0, 0, 1), (0, 1, 1, 0)),
    ),
    _four_footed_gait(
      'pace',
      _TROT_SPEED,
      _WALK_DURATION,
      _STEP_PHASES,
      stepping((1, 0, 1, 0), (0, 1, 0, 1)),
    ),
    _four_footed_gait(
      'bound',
      _BOUND_SPEED,
      _BOUND_DURATION,
      _BOUND_PHASES,
      np.array([hind, none, front, none, none]),
      in_sync=True,
    ),
    _on_four_feet(_leap('forward'), 'pronk_forward'),
  ]
  return {motion.name: motion for motion in motions}


@functools.cache
def modes() -> Mapping[str, motion_lib.ReferenceMotion]:
  """Returns every mode of two feet by its name."""
  motions = [_idle()]
  motions += [_walk(direction) for direction in _DIRECTIONS]
  motions += [_leap(direction) for direction in _DIRECTIONS]
  far = _leap('forward', _FAR_LENGTH)
  motions += [dataclasses.replace(far, name='leap_far', mirror='leap_far')]
  motions += [_hop('forward'), _launch(), _descent()]
  motions += [_turn(side) for side in ('left', 'right')]
  return {motion.name: motion for motion in motions}


# Table I of the paper, all modes of two feet, and the small sets of the quick
# starts.
SETS: Mapping[str, tuple[str, ...]] = {
  'pi1': ('idle',)
  + tuple(f'walk_{d}' for d in _DIRECTIONS)
  + tuple(f'leap_{d}' for d in _DIRECTIONS),
  'pi2': ('idle', 'walk_forward', 'leap_forward', 'launch'),
  'pi3': ('idle', 'walk_forward', 'hop_forward', 'leap_forward'),
  'pi_all': ('idle',)
  + tuple(f'walk_{d}' for d in _DIRECTIONS)
  + tuple(f'leap_{d}' for d in _DIRECTIONS)
  + ('hop_forward', 'launch', 'step_down', 'turn_left', 'turn_right'),
  'pi_parkour': (
    'idle',
    'walk_forward',
    'leap_forward',
    'leap_far',
    'launch',
    'step_down',
  ),
  'quickstart': ('idle', 'walk_forward', 'leap_forward'),
  'quadruped': ('stand', 'trot_forward', 'pronk_forward'),
}


def resolve(
  spec: str | os.PathLike[str] | Sequence[str],
  extra: Iterable[motion_lib.ReferenceMotion] = (),
  stand_height: float = constants.STAND_HEIGHT,
) -> tuple[motion_lib.ReferenceMotion, ...]:
  """Resolves `spec` to motions, in order.

  Args:
    spec: a set's name ('pi2'), mode names separated by commas, a sequence of
      mode names, or a mode file: a path that ends in .yaml, .yml or .json, for
      all of its modes.
    extra: user modes that may be named besides the library's; they take
      precedence over a library mode of the same name.
    stand_height: of the robot's trunk, metres, to which the library's modes
      are scaled; see `motion.scaled`.

  Raises:
    ValueError: a name is unknown; the message lists the known ones; or the file
      is not a mode file.
  """
  if isinstance(spec, os.PathLike):
    spec = os.fspath(spec)
  if isinstance(spec, str) and spec.lower().endswith(_FILES):
    from dmc_multimode.modes import files as mode_files  # It imports this one.

    return mode_files.load(spec, stand_height)
  mine = {
    name: motion_lib.scaled(motion, stand_height)
    for name, motion in {**modes(), **four_footed_modes()}.items()
  }
  known = {**mine, **{motion.name: motion for motion in extra}}
  if isinstance(spec, str):
    names: Sequence[str] = SETS.get(spec) or [
      n.strip() for n in spec.split(',')
    ]
  else:
    names = spec
  unknown = [name for name in names if name not in known]
  if unknown:
    raise ValueError(
      f'Unknown mode {unknown[0]!r}; modes are {", ".join(known)}; '
      f'sets are {", ".join(SETS)}.'
    )
  return tuple(known[name] for name in names)


@functools.cache
def codebook() -> codebook_lib.Codebook:
  """Returns the shipped latents of all modes of the library."""
  return codebook_lib.load(
    resources.path('pretrained', 'library') / codebook_lib.FILE
  )


def mode_set(
  spec: str | os.PathLike[str] | Sequence[str],
  extra: Iterable[motion_lib.ReferenceMotion] = (),
  stand_height: float = constants.STAND_HEIGHT,
) -> mode_set_lib.ModeSet:
  """Returns the mode set of `spec`, with the shipped latents.

  Modes of four feet and those of a file have none: sets of them have one-hot
  commands.

  Args:
    spec: see `resolve`.
    extra: see `resolve`.
    stand_height: see `resolve`.

  Raises:
    ValueError: a name is unknown, or the mode has no shipped latent; or the
      file is not a mode file.
  """
  motions = resolve(spec, extra, stand_height)
  of_four_feet = all(motion.name in four_footed_modes() for motion in motions)
  if of_four_feet or str(spec).lower().endswith(_FILES):
    return mode_set_lib.one_hot(motions)
  names = [motion.name for motion in motions]
  return mode_set_lib.ModeSet(motions, codebook().subset(names))
