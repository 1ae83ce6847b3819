"""Disturbances: another body, servo and ground in every episode.

`Disturbances` is a table, one row each: unit, nominal value, and the range that
a randomised training draws from, for every episode, every row or some of them;
an evaluation has the nominal robot, or fixes a row by a range of no width:
`Disturbances(friction=(0.4, 0.4))`.

Delays are of the task, see `delayed`, and the drift of odometry of one of its
observations, see `odometry_error`. All others change the model of a world, see
`Body`.
"""

import dataclasses
import functools
from typing import Annotated, Any, Callable, Mapping

import mujoco
import numpy as np
import pydantic

from dmc_multimode.suite.imitation import observations
from dmc_multimode.utils import config as config_lib

_STRETCH = 0.02  # Of the way, by an odometry drift of 1.
_TURN = float(np.deg2rad(1.0))  # Radians a metre, likewise.


def _check_range(value: tuple[float, float]) -> tuple[float, float]:
  if value[0] > value[1]:
    raise ValueError(f'a range is LOW,HIGH, got {value[0]},{value[1]}')
  return value


Range = Annotated[tuple[float, float], pydantic.AfterValidator(_check_range)]


def _row(unit: str, nominal: float, low: float, high: float) -> Any:
  """Declares a disturbance: its unit, nominal value and training range."""
  return dataclasses.field(
    default=(nominal, nominal),
    metadata={'unit': unit, 'nominal': nominal, 'range': (low, high)},
  )


@config_lib.dataclass
class Disturbances:
  """Ranges (low, high) from which each episode's robot is drawn.

  Attributes:
    action_delay: from the policy's action to the servos, seconds.
    friction: sliding friction of robot and ground.
    mass: factor of all masses and inertias.
    payload: mass added at the trunk's centre, kg.
    centre_of_mass: forward shift of the trunk's centre of mass, metres.
    motor_strength: factor of the servos' gains and torque limits.
    slope: of the ground, up along x, radians.
    odometry_drift: of the observed displacement, for worlds that observe one; 1
      is 2 percent of the way and 1 degree a metre, -1 the same the other way.
  """

  action_delay: Range = _row('s', 0.0, 0.0, 0.03)
  friction: Range = _row('', 0.9, 0.35, 1.2)
  mass: Range = _row('', 1.0, 0.9, 1.1)
  payload: Range = _row('kg', 0.0, -0.3, 2.0)
  centre_of_mass: Range = _row('m', 0.0, -0.02, 0.02)
  motor_strength: Range = _row('', 1.0, 0.8, 1.2)
  slope: Range = _row('rad', 0.0, 0.0, 0.0)
  odometry_drift: Range = _row('', 0.0, 0.0, 0.0)

  def __post_init__(self) -> None:
    for name, least in (
      ('action_delay', 0.0),
      ('friction', 0.0),
      ('mass', 0.1),
      ('payload', -5.0),
      ('motor_strength', 0.0),
    ):
      if getattr(self, name)[0] < least:
        raise ValueError(f'{name} is at least {least:g}')
    if self.action_delay[1] > 0.3:
      raise ValueError('action_delay is at most 0.3 s')
    if max(map(abs, self.slope)) > 0.8:
      raise ValueError('slope is between -0.8 and 0.8 rad')

  @functools.cached_property
  def active(self) -> tuple[str, ...]:
    """Names of the rows that are not nominal."""
    return tuple(
      row.name
      for row in dataclasses.fields(self)
      if getattr(self, row.name) != (row.metadata['nominal'],) * 2
    )

  def fixed(self, **values: float) -> 'Disturbances':
    """Returns the disturbances with these rows fixed."""
    return dataclasses.replace(
      self, **{name: (value, value) for name, value in values.items()}
    )


NOMINAL = Disturbances()
# Of the rows' training ranges.
RANDOMISED = Disturbances(
  **{
    row.name: row.metadata['range'] for row in dataclasses.fields(Disturbances)
  }
)


def nominal(count: int) -> dict[str, np.ndarray]:
  """Returns the nominal values of `count` robots by row, [N] each."""
  return {
    row.name: np.full(count, row.metadata['nominal'])
    for row in dataclasses.fields(Disturbances)
  }


def draw(
  config: Disturbances,
  share: float,
  count: int,
  random_state: np.random.RandomState,
  fraction: float = 1.0,
) -> dict[str, np.ndarray]:
  """Draws the disturbances of `count` robots.

  Args:
    config: the ranges.
    share: of the way from the nominal values to the drawn ones, in [0, 1].
    count: N.
    random_state: source; nothing is drawn for nominal rows.
    fraction: probability of each row to be drawn, and not nominal.

  Returns:
    Values by row, [N] each.
  """
  values = nominal(count)
  for name in config.active:
    low, high = getattr(config, name)
    drawn = random_state.uniform(low, high, count)
    if fraction < 1:
      kept = random_state.uniform(size=count) >= fraction
      drawn = np.where(kept, values[name], drawn)
    values[name] += share * (drawn - values[name])
  return values


def delayed(
  actions: np.ndarray, delay: np.ndarray, timestep: float, substeps: int
) -> np.ndarray:
  """Returns the joint targets of each physics step of a control step.

  Args:
    actions: the last H actions, the newest first, radians, [B, H, A].
    delay: seconds, [B]; at most H - 1 control steps.
    timestep: of the physics, seconds.
    substeps: S, physics steps in a control step.

  Returns:
    Radians, [B, S, A].
  """
  late = np.rint(delay / timestep).astype(np.int64)[:, None]
  age = -((np.arange(substeps) - late) // substeps)
  return actions[np.arange(len(actions))[:, None], age]


def odometry_error(travelled: np.ndarray, drift: np.ndarray) -> np.ndarray:
  """Returns errors of odometry, metres, [B, 2].

  The estimate is too long by `_STRETCH` and turned by half of `_TURN` a metre,
  as that of a straight way is whose heading drifts by `_TURN` a metre.

  Args:
    travelled: x and y of the trunk since the command, metres, [B, 2].
    drift: the row `odometry_drift`, [B].
  """
  angle = drift * _TURN / 2 * np.linalg.norm(travelled, axis=1)
  turned = observations.in_heading(travelled, -angle)
  return (1 + _STRETCH * drift)[:, None] * turned - travelled


# Model fields that the rows change; those of mass need derived constants anew.
_MASSES = ('body_mass', 'body_inertia', 'body_ipos')
_FIELDS: Mapping[str, tuple[str, ...]] = {
  'friction': ('geom_friction',),
  'mass': _MASSES,
  'payload': _MASSES,
  'centre_of_mass': _MASSES,
  'motor_strength': (
    'actuator_gainprm',
    'actuator_biasprm',
    'actuator_forcerange',
  ),
  'slope': ('opt.gravity',),
}


class Body:
  """Writes disturbances into the models of worlds.

  Attributes:
    changes_mass: whether derived constants follow from what `write` writes.
  """

  def __init__(
    self,
    model: mujoco.MjModel,
    config: Disturbances,
    expand: Callable[[str], np.ndarray],
    trunk: int,
  ):
    """Expands the fields that the active rows change.

    Args:
      model: the nominal model, with one robot.
      config: the ranges.
      expand: returns a field of all worlds' models, [B, ...], to write to.
      trunk: index of the trunk's body.
    """
    names = sorted({f for row in config.active for f in _FIELDS.get(row, ())})
    self._nominal = {
      name: np.array(
        model.opt.gravity if name == 'opt.gravity' else getattr(model, name)
      )
      for name in names
    }
    self._fields = {name: expand(name) for name in names}
    self._trunk = trunk
    self.changes_mass = 'body_mass' in self._fields

  def restore(self, ids: np.ndarray) -> None:
    """Writes the nominal model's fields into the worlds `ids`, [N]."""
    for name, field in self._fields.items():
      field[ids] = self._nominal[name]

  def write(self, ids: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
    """Writes the values of the worlds `ids`, [N] each."""
    for name, field in self._fields.items():
      rows = np.repeat(self._nominal[name][None], len(ids), axis=0)
      if name == 'geom_friction':
        # Of a contact MuJoCo takes the larger one: both have to change.
        rows[:, :, 0] = values['friction'][:, None]
      elif name in ('body_mass', 'body_inertia'):
        rows *= values['mass'].reshape(-1, *(1,) * (rows.ndim - 1))
        if name == 'body_mass':
          rows[:, self._trunk] += values['payload']
      elif name == 'body_ipos':
        rows[:, self._trunk, 0] += values['centre_of_mass']
      elif name == 'actuator_gainprm':
        rows[:, :, 0] *= values['motor_strength'][:, None]
      elif name == 'actuator_biasprm':
        rows[:, :, 1:3] *= values['motor_strength'][:, None, None]
      elif name == 'actuator_forcerange':
        rows *= values['motor_strength'][:, None, None]
      elif name == 'opt.gravity':
        gravity = np.linalg.norm(rows, axis=1)
        rows[:, 0] = -gravity * np.sin(values['slope'])
        rows[:, 2] = -gravity * np.cos(values['slope'])
      field[ids] = rows
