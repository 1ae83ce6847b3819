"""A robot is a declaration: a file that names a model and what it is to a task.

    name: mini_biped
    model: mini_biped.xml          # MJCF, in the folder of this file
    trunk: trunk                   # the body that carries the robot
    feet: [left_foot, right_foot]  # two or four sites, geoms or bodies
    joints: [left_hip, left_knee, right_hip, right_knee]  # as actions are
    pose: {left_knee: 0.4, right_knee: 0.4}  # radians; 0 for the others
    servos: {stiffness: 30, damping: 0.5, limit: 30}  # or the model's own
    armature: 0.003                # kg m^2; or the model's own
    ranges: {left_hip: [-1, 1]}    # radians, of joints without one in the model
    visuals: false                 # leaves out what is for the eye alone
    control_timestep: 0.03         # seconds

The model may also be in an installed package, `package:NAME/PATH`: then files
are read from that package's folder alone, and policies keep the hash of the
model, not the model.

Servos apply clip(stiffness (a - q) - damping dq/dt, +-limit) at every physics
step; each of the three may be a table by joint. Tables by joint may have
patterns for names, `'*_knee': 0.4`; a joint has the value of its own name, or
else of the last pattern that it matches. All else follows from the model
(`derivation`): heights, mass, bounds of actions, the action that stands, the
exchange of left and right.

In the standing pose the robot faces +x with its trunk upright, and left and
right are each other's mirror image. Lengths of the task are those of the mini
biped, whose trunk stands 0.5 m high, and grow and shrink with a robot's `size`.
"""

from __future__ import annotations

import base64
import dataclasses
import fnmatch
import functools
import hashlib
import json
import os
import pathlib
import re
from typing import Annotated, Any, Mapping, TYPE_CHECKING, TypeVar

import pydantic

from dmc_multimode.utils import config
from dmc_multimode.utils import constants
from dmc_multimode.utils import files
from dmc_multimode.utils import resources
from dmc_multimode.utils import yaml_lines
from dmc_multimode.walkers import robot_files

if TYPE_CHECKING:
  from dmc_multimode.walkers import derivation

MAX_BYTES = 100_000  # Of a declaration.
MAX_JOINTS = 64
MINI_BIPED = 'mini_biped'
_SHIPPED = 'robots'  # Folder of the declarations in `xml/`.
_DIGEST = 12  # Characters of a hash that are shown.
_T = TypeVar('_T')
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_-]{0,63}')
_Name = Annotated[str, pydantic.Field(min_length=1, max_length=100)]
_Path = Annotated[str, pydantic.Field(min_length=1, max_length=300)]
_Angle = Annotated[float, pydantic.Field(ge=-7.0, le=7.0)]
_Gain = Annotated[float, pydantic.Field(gt=0, le=1e5)]
_Damping = Annotated[float, pydantic.Field(ge=0, le=1e5)]


@config.dataclass
class Servos:
  """Gains of the joints' servos: one for all, or a table by joint.

  Attributes:
    stiffness: Nm/rad (N/m of a slide).
    damping: Nm s/rad.
    limit: of the torque, Nm.
  """

  stiffness: _Gain | dict[str, _Gain]
  damping: _Damping | dict[str, _Damping]
  limit: _Gain | dict[str, _Gain]


@config.dataclass
class Declaration:
  """Content of a robot's file; see the module's docstring.

  Patterns in its tables become the joints that match, so that a robot and its
  hash do not depend on how its tables were written.

  Attributes:
    name: of the robot.
    model: MJCF file, in the folder of the declaration; or
      `package:NAME/PATH`, in that of an installed package.
    trunk: body that carries the robot, the only one of the world.
    feet: sites, geoms or bodies (left, right), or (front left, front right,
      hind left, hind right).
    joints: all joints of the model, in its order, which is that of the actions.
    pose: in which the robot stands, radians (metres of slides) by joint; 0 for
      those that it leaves out.
    servos: of the joints; None for the model's own position actuators.
    armature: of each joint, kg m^2; None for the model's own.
    ranges: lower and upper limits, radians (metres of slides), of joints whose
      model has none; no others, for a model knows what its joints bear.
    visuals: false leaves out geoms that touch nothing, and meshes that only
      they have.
    asymmetry: by how much left and right may differ: accelerations of the
      mirror image, in those of the robot; None for not at all.
    control_timestep: period of a policy, seconds.
  """

  name: _Name
  model: _Path
  trunk: _Name
  feet: tuple[_Name, ...]
  joints: Annotated[
    tuple[_Name, ...], pydantic.Field(min_length=1, max_length=MAX_JOINTS)
  ]
  pose: dict[str, _Angle] = pydantic.Field(default_factory=dict)
  servos: Servos | None = None
  armature: Annotated[float, pydantic.Field(ge=0, le=100.0)] | None = None
  ranges: dict[str, tuple[_Angle, _Angle]] = pydantic.Field(
    default_factory=dict
  )
  visuals: bool | None = None  # None is true, and none of the hash.
  asymmetry: Annotated[float, pydantic.Field(ge=0, le=0.5)] | None = None
  control_timestep: Annotated[float, pydantic.Field(ge=1e-3, le=0.2)] = (
    constants.CONTROL_TIMESTEP
  )

  def __post_init__(self) -> None:
    if not _NAME.fullmatch(self.name):
      raise ValueError(
        'name: at most 64 letters, digits, - and _, a letter first'
      )
    if len(self.feet) not in (2, 4):
      raise ValueError(f'feet: two or four, got {len(self.feet)}')
    for field in ('feet', 'joints'):
      names = getattr(self, field)
      if len(set(names)) < len(names):
        raise ValueError(f'{field}: a name is given twice')
    # Frozen, but for this: what is stored has no patterns.
    for field in ('pose', 'ranges'):
      object.__setattr__(
        self, field, self._by_joint(field, getattr(self, field))
      )
    for name, (low, high) in self.ranges.items():
      if low >= high:
        raise ValueError(f'ranges: {name!r:.80} has {low:g} to {high:g}')
    if self.servos:
      tables = {
        field: self._by_joint(f'servos.{field}', value, complete=True)
        for field in ('stiffness', 'damping', 'limit')
        if isinstance(value := getattr(self.servos, field), dict)
      }
      servos = dataclasses.replace(self.servos, **tables)
      object.__setattr__(self, 'servos', servos)

  def _by_joint(
    self, field: str, table: Mapping[str, _T], complete: bool = False
  ) -> dict[str, _T]:
    """Returns a table by joint of a table by joints and patterns.

    Args:
      field: its name, for the errors.
      table: values. A joint has that of its own name, or else of the last
        pattern that it matches.
      complete: whether all joints must have values.

    Raises:
      ValueError: a name or pattern is for no joint, or a joint is missing.
    """
    chosen: dict[str, str] = {}  # Names or patterns, by joint.
    for key in table:
      if key in self.joints:  # Whatever else it matches as a pattern.
        chosen[key] = key
        continue
      matching = [n for n in self.joints if fnmatch.fnmatchcase(n, key)]
      if not matching:
        raise ValueError(f'{field}: {key!r:.80} matches none of the joints')
      chosen |= {name: key for name in matching if name not in table}
    for key in table:
      if key not in chosen.values():
        raise ValueError(
          f'{field}: {key!r:.80} counts for no joint: its name or a later '
          'pattern is there for each; general patterns come first'
        )
    for name in self.joints if complete else ():
      if name not in chosen:
        raise ValueError(f'{field}: {name!r:.80} is missing')
    return {name: table[chosen[name]] for name in self.joints if name in chosen}


class Robot:
  """A declared robot, with its model.

  Two robots are equal if their declarations and models are.

  Attributes:
    declaration: what its file says.
    model: MJCF and assets.
    digest: hash of declaration and model, hexadecimal.
  """

  def __init__(self, declaration: Declaration, model: robot_files.Model):
    """Takes what was read; compiles nothing."""
    self.declaration, self.model = declaration, model
    self.digest = _digest(declaration, model)

  @property
  def name(self) -> str:
    """Name of the robot."""
    return self.declaration.name

  @property
  def joints(self) -> tuple[str, ...]:
    """Names of the joints, in the order of actions, J of them."""
    return self.declaration.joints

  @property
  def num_joints(self) -> int:
    """Number J of the joints, and of an action's numbers."""
    return len(self.declaration.joints)

  @property
  def num_feet(self) -> int:
    """Number F of the feet."""
    return len(self.declaration.feet)

  @functools.cached_property
  def is_mini_biped(self) -> bool:
    """True for the robot of this package, whose kinematics are known."""
    return self == mini_biped()

  @functools.cached_property
  def derived(self) -> derivation.Derived:
    """Numbers that follow from the model.

    Raises:
      ValueError: in one line, the model and the declaration do not fit.
    """
    from dmc_multimode.walkers import derivation  # Late: it compiles models.

    try:
      return derivation.derive(self)
    except ValueError as error:
      raise ValueError(f'robot {self.name}: {error}') from error

  @property
  def stand_height(self) -> float:
    """Metres from the feet to the trunk's origin in the standing pose."""
    return self.derived.stand_height

  @property
  def size(self) -> float:
    """Height in the standing pose, in those of the mini biped."""
    return self.stand_height / constants.STAND_HEIGHT

  def to_dict(self) -> dict[str, Any]:
    """Returns declaration, model and hash as JSON values.

    The model of an installed package stays there.
    """
    values: dict[str, Any] = {
      'declaration': config.to_dict(self.declaration),
      'digest': self.digest,
    }
    if not robot_files.is_packaged(self.declaration.model):
      values['model'] = self.model.xml
      values['assets'] = {
        name: base64.b64encode(content).decode()
        for name, content in self.model.assets.items()
      }
    return values

  def __eq__(self, other: object) -> bool:
    return isinstance(other, Robot) and self.digest == other.digest

  def __hash__(self) -> int:
    return hash(self.digest)

  def __repr__(self) -> str:
    return f'{self.name} ({self.digest[:_DIGEST]})'

  def __deepcopy__(self, memo: dict[int, Any]) -> Robot:
    return self  # It never changes.


def names() -> list[str]:
  """Returns the names of the robots whose declarations come with the package.

  All but the mini biped have their models in packages of the extra `robots`.
  """
  folder = resources.path('xml', _SHIPPED)
  return [MINI_BIPED, *sorted(path.stem for path in folder.glob('*.yaml'))]


def load(path: str | os.PathLike[str]) -> Robot:
  """Reads a robot's YAML or JSON file, with its model, and checks both.

  The model's files are read from one folder alone: that of the declaration, or
  that of the package which it names.

  Args:
    path: of the file, or one of `names`.

  Raises:
    OSError: the file is missing or cannot be read.
    ValueError: in one line that begins with the file, what is wrong.
  """
  name = files.expand(path)
  place = _place(name)
  content = files.read_bounded(place, MAX_BYTES)
  try:
    robot = _parse(content, place)
    # Errors of the model are found here, and not hours later.
    assert robot.derived
  except yaml_lines.LineError as error:
    raise ValueError(f'{name}:{error.line}: {error}') from error
  except ValueError as error:
    reason = str(error).rstrip('.').removeprefix('robot ')
    raise ValueError(f'{name}: {reason}.') from error
  return robot


def _place(name: str) -> pathlib.Path:
  """Returns the place of a robot's file, from the file or a shipped name."""
  if name == MINI_BIPED:
    return resources.path('xml', 'mini_biped.yaml')
  if name in names():
    return resources.path('xml', f'{_SHIPPED}/{name}.yaml')
  place = pathlib.Path(name).absolute()
  if _NAME.fullmatch(name) and not place.exists():
    raise FileNotFoundError(
      f'no robot named {name!r}, and no such file; there are '
      f'{", ".join(names())}, and files of yours.'
    )
  return place


def from_dict(values: Mapping[str, Any]) -> Robot:
  """Returns the robot of a `to_dict`.

  Raises:
    ValueError: the values are those of no robot, or their hash is another; or
      its model is in a package that is not installed, or has another by now.
  """
  try:
    declaration = config.build(Declaration, values['declaration'])
    if robot_files.is_packaged(declaration.model):
      return _installed(declaration, values['digest'])
    model = robot_files.Model(
      str(values['model']),
      {
        str(name): base64.b64decode(content, validate=True)
        for name, content in values['assets'].items()
      },
    )
    robot_files.check(model)
    robot = Robot(declaration, model)
    if robot.digest != values['digest']:
      raise ValueError('its declaration or model is not that of its hash')
  except (AttributeError, KeyError, TypeError, ValueError) as error:
    lacks = isinstance(error, KeyError)
    reason = f'it lacks {error}' if lacks else str(error).rstrip('.')
    raise ValueError(f'not a robot: {reason}.') from error
  return robot


def _installed(declaration: Declaration, digest: str) -> Robot:
  """Returns a robot with the model of an installed package."""
  nowhere = pathlib.Path()  # The package has all of the files.
  model = _read(nowhere, declaration)
  robot = Robot(declaration, model)
  if robot.digest != digest:
    raise ValueError(
      f'its model {declaration.model} is not that of its hash: another version '
      'of the package is installed'
    )
  return robot


@functools.cache
def mini_biped() -> Robot:
  """Returns the robot of `xml/mini_biped.yaml`."""
  path = resources.path('xml', 'mini_biped.yaml')
  return _parse(path.read_bytes(), path)


def find(robot: Robot | str | os.PathLike[str] | None) -> Robot:
  """Returns a robot, that of a file or name, or the mini biped for None."""
  if robot is None:
    return mini_biped()
  return robot if isinstance(robot, Robot) else load(robot)


def _parse(content: bytes, path: pathlib.Path) -> Robot:
  """Returns the robot of a declaration; compiles nothing."""
  try:
    text = content.decode('utf-8-sig')
  except UnicodeDecodeError:
    raise ValueError('it is not text in UTF-8') from None
  values, _ = yaml_lines.parse(text, path.suffix.lower() == '.json')
  declaration = config.build(Declaration, values)
  return Robot(declaration, _read(path.parent, declaration))


def _read(folder: pathlib.Path, declaration: Declaration) -> robot_files.Model:
  """Returns the model of a declaration, from its folder or its package."""
  return robot_files.read(
    folder,
    declaration.model,
    declaration.trunk,
    visuals=declaration.visuals is not False,
  )


def _digest(declaration: Declaration, model: robot_files.Model) -> str:
  """Returns the hash of a robot, hexadecimal.

  Fields that a declaration leaves out are none of it, so that it stays what it
  is when later versions have more.
  """
  declared = {
    field: value
    for field, value in config.to_dict(declaration).items()
    if value is not None and value != {}
  }
  assets = {
    name: hashlib.sha256(content).hexdigest()
    for name, content in model.assets.items()
  }
  text = json.dumps([declared, model.xml, assets], sort_keys=True)
  return hashlib.sha256(text.encode()).hexdigest()
