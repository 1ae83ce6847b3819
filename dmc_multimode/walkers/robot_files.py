"""The files of a robot: read from one folder, bounded, and made one model.

A user's model is data. It is read from one folder alone, that of its
declaration or of an installed package, no larger than a robot has to be;
whatever makes a small file a large model, or loads code, is refused. What
belongs to a scene and not to a robot (options, keyframes, floors, lights and
cameras of the world) is left out: arenas and tasks have their own.
"""

import collections
import copy
import importlib.util
import math
import pathlib
import re
from typing import Iterator, NamedTuple
from xml.etree import ElementTree

from dmc_multimode.utils import files

MAX_MODEL_BYTES = 2_000_000  # Of one MJCF file.
MAX_ASSET_BYTES = 16 << 20  # Of all meshes and textures together.
MAX_PACKAGED_BYTES = 64 << 20  # Likewise, of a package's model.
PACKAGE = 'package:'  # In the name of a model: PACKAGE, its name, /, a path.
_MAX_FILES = 64
_MAX_ELEMENTS, _MAX_DEPTH = 5000, 100  # Of the MJCF, and its nesting.
_MAX_TEXTURE = 4096  # Pixels: of the sides of a texture that MuJoCo draws.
_ASSETS = ('.stl', '.obj', '.msh', '.png')
_KEPT = (
  'compiler',
  'default',
  'asset',
  'worldbody',
  'contact',
  'equality',
  'tendon',
  'actuator',
  'sensor',
)
# Of the world in the file, but not of the robot.
_SCENERY = ('geom', 'site', 'light', 'camera')
_PACKAGE_NAME = re.compile('[A-Za-z_][A-Za-z0-9_]*')
_NOT_FINITE = re.compile(r'[-+]?(nan|inf|infinity)', re.IGNORECASE)
_REFUSED = {
  'attach': 'names another model',
  'model': 'names another model',
  'composite': 'makes many bodies of one',
  'flexcomp': 'makes many bodies of one',
  'replicate': 'makes many bodies of one',
  'extension': 'loads plugins',
  'plugin': 'loads plugins',
  'hfield': 'is ground, which arenas have',
  'skin': 'is for the eye alone',
}
_FOLDERS = {  # Attributes of the compiler: the folders of assets.
  'mesh': ('meshdir', 'assetdir'),
  'texture': ('texturedir', 'assetdir'),
}
_DIRECTORIES = ('meshdir', 'texturedir', 'assetdir', 'strippath')
_FILES = ('file', *(f'file{side}' for side in ('right', 'left', 'up', 'down')))
_FILES += ('filefront', 'fileback')


class Model(NamedTuple):
  """A robot's model without files.

  Attributes:
    xml: MJCF of the robot alone, without includes.
    assets: contents of its meshes and textures, by the names in the MJCF:
      those of the files, or their paths from the folder of such files where
      others have the same name.
  """

  xml: str
  assets: dict[str, bytes]


def read(
  folder: pathlib.Path, name: str, trunk: str, visuals: bool = True
) -> Model:
  """Reads a robot's model.

  Args:
    folder: of the declaration; it alone may be read, or the package that the
      name says.
    name: of the MJCF file in it; its meshes are named from where it is.
    trunk: name of the body that carries the robot.
    visuals: false leaves out geoms that touch nothing and weigh nothing, and
      meshes that no other has, which are not read.

  Raises:
    ValueError: in one line, a file is missing, outside the folder, too large,
      or not a robot's model; or the package is not installed.
  """
  limit = MAX_ASSET_BYTES
  if is_packaged(name):
    package, _, name = name.removeprefix(PACKAGE).partition('/')
    folder, limit = _package_folder(package), MAX_PACKAGED_BYTES
  reader = _Reader(folder, limit)
  root = reader.open(name)
  reader.include(root)
  _check_elements(root)
  for section in [part for part in root if part.tag not in _KEPT]:
    root.remove(section)
  _leave_scenery(root, trunk)
  if not visuals:
    _leave_visuals(root)
  assets = reader.read_assets(root)
  return Model(ElementTree.tostring(root, encoding='unicode'), assets)


def is_packaged(name: str) -> bool:
  """Returns whether the model of a name is in an installed package."""
  return name.startswith(PACKAGE)


def is_here(name: str) -> bool:
  """Returns whether the model of a name needs no package, or has it."""
  if not is_packaged(name):
    return True
  package, _, _ = name.removeprefix(PACKAGE).partition('/')
  return importlib.util.find_spec(package) is not None


def _package_folder(name: str) -> pathlib.Path:
  """Returns the folder of an installed package, which is not imported."""
  if not _PACKAGE_NAME.fullmatch(name):
    raise ValueError(f'{PACKAGE}{name!r:.80} names no package.')
  spec = importlib.util.find_spec(name)
  if spec is None or not spec.submodule_search_locations:
    raise ValueError(
      f'the package {name} is not installed; the robots that come with '
      'dmc_multimode need: pip install "dmc_multimode[robots]".'
    )
  return pathlib.Path(list(spec.submodule_search_locations)[0])


def check(model: Model) -> None:
  """Checks a model that was not read here, such as that of a policy's file.

  Raises:
    ValueError: in one line, it is none that `read` returns.
  """
  if len(model.xml) > 4 * MAX_MODEL_BYTES:
    raise ValueError('the model is too large.')
  if sum(map(len, model.assets.values())) > MAX_ASSET_BYTES:
    raise ValueError('the meshes and textures are too large.')
  root = _parsed(model.xml, 'the model')
  _check_elements(root)
  for element in root.iter():
    if element.tag == 'include' or set(element.attrib) & {*_DIRECTORIES}:
      raise ValueError('the model reads other files.')
  for element, attribute in _files(root):
    if element.attrib[attribute] not in model.assets:
      raise ValueError('the model reads other files.')


def _parsed(text: str, what: str) -> ElementTree.Element:
  """Returns the root of an MJCF text; `what` is for the errors."""
  try:
    if '<!DOCTYPE' in text or '<!ENTITY' in text:
      raise ValueError('it declares entities')
    root = ElementTree.fromstring(text)
  except (ElementTree.ParseError, ValueError) as error:
    raise ValueError(f'{what} is not MJCF: {error}.') from None
  if root.tag not in ('mujoco', 'mujocoinclude'):
    raise ValueError(f'{what} is not MJCF: <{root.tag}>.')
  return root


class _TooLarge(ValueError):
  """A file is larger than it may be."""


class _Reader:
  """Reads the files of one folder, each once."""

  def __init__(self, folder: pathlib.Path, limit: int):
    """Reads nothing yet.

    Args:
      folder: that may be read.
      limit: bytes of all assets together.
    """
    self._folder = self._base = folder.resolve()
    self._limit = limit
    self._seen: set[pathlib.Path] = set()

  def _path(self, name: str, kind: str) -> pathlib.Path:
    """Returns the place of a file; `kind` is for the errors."""
    path = (self._base / name).resolve()
    if not path.is_relative_to(self._folder):
      raise ValueError(
        f'{kind} {name!r:.80} is outside the folder of the robot.'
      )
    return path

  def _content(self, name: str, kind: str, limit: int) -> bytes:
    """Returns a file's content; `kind` is for the errors."""
    path = self._path(name, kind)
    self._seen.add(path)
    if len(self._seen) > _MAX_FILES:
      raise ValueError(f'a robot has at most {_MAX_FILES} files.')
    try:
      return files.read_bounded(path, limit)
    except OSError:
      raise ValueError(f'{kind} {name!r:.80} cannot be read.') from None
    except ValueError:
      raise _TooLarge(
        f'{kind} {name!r:.80} is too large: {limit:,} bytes are the most.'
      ) from None

  def open(self, name: str) -> ElementTree.Element:
    """Returns the root of the robot's MJCF, beside which its files are."""
    root = self.parse(name)
    self._base = (self._folder / name).parent.resolve()
    return root

  def parse(self, name: str) -> ElementTree.Element:
    """Returns the root of an MJCF file."""
    content = self._content(name, 'the model', MAX_MODEL_BYTES)
    try:
      text = content.decode('utf-8-sig')
    except UnicodeDecodeError:
      raise ValueError(f'the model {name!r:.80} is not UTF-8.') from None
    return _parsed(text, f'the model {name!r:.80}')

  def include(self, root: ElementTree.Element) -> None:
    """Replaces includes by what they include, in place."""
    for parent in list(root.iter()):
      for child in [part for part in parent if part.tag == 'include']:
        name = child.get('file', '')
        path = (self._base / name).resolve()
        if path in self._seen:
          raise ValueError(f'the model includes {name!r:.80} twice.')
        included = self.parse(name)
        self.include(included)
        place = list(parent).index(child)
        parent.remove(child)
        for offset, part in enumerate(included):
          parent.insert(place + offset, part)

  def read_assets(self, root: ElementTree.Element) -> dict[str, bytes]:
    """Reads the files of assets, and renames them in the MJCF."""
    folders: dict[str, str] = {}
    for compiler in root.iter('compiler'):
      for option in _DIRECTORIES:
        value = compiler.attrib.pop(option, None)
        if value is not None:
          folders[option] = value
    named = []
    for element, attribute in _files(root):
      places = _FOLDERS.get(element.tag, ())
      below = next((folders[place] for place in places if place in folders), '')
      file = pathlib.PurePosixPath(element.attrib[attribute])
      if file.suffix.lower() not in _ASSETS:
        raise ValueError(
          f'{element.tag} {str(file)!r:.80} is none of {", ".join(_ASSETS)}.'
        )
      named.append((element, attribute, str(below / file)))
    contents = self._contents([(name, part.tag) for part, _, name in named])
    alike = collections.defaultdict(set)  # Contents of files by their names.
    for name, content in contents.items():
      alike[pathlib.PurePosixPath(name).name].add(content)
    found = {}
    for element, attribute, path in named:
      # Named as it was, for MuJoCo names meshes by their files.
      name = pathlib.PurePosixPath(path).name
      name = name if len(alike[name]) == 1 else path
      found[name] = contents[path]
      element.set(attribute, name)
    return found

  def _contents(self, named: list[tuple[str, str]]) -> dict[str, bytes]:
    """Returns the contents of assets by their paths, from these and kinds."""
    contents: dict[str, bytes] = {}
    for name, kind in named:
      rest = self._limit - sum(map(len, contents.values()))
      try:
        if name not in contents:
          contents[name] = self._content(name, kind, rest)
      except _TooLarge:
        sizes = {
          path: path.stat().st_size
          for path in (self._path(*each) for each in named)
          if path.is_file()
        }
        raise ValueError(
          f'the meshes and textures are {sum(sizes.values()) / 2**20:.1f} MB '
          f'in all, and {self._limit / 2**20:g} MB are the most: {name:.80} '
          'does not fit; visual meshes that collide with nothing may be left '
          'out (visuals: false).'
        ) from None
    return contents


def _files(
  root: ElementTree.Element,
) -> Iterator[tuple[ElementTree.Element, str]]:
  """Yields the elements that name files, with the attribute that does."""
  for element in root.iter():
    for attribute in _FILES:
      if attribute in element.attrib:
        yield element, attribute


def _check_elements(root: ElementTree.Element) -> None:
  """Raises ValueError for what a robot's model may not have."""
  level, count = [root], 0
  for _ in range(_MAX_DEPTH):
    count += len(level)
    level = [child for element in level for child in element]
  if level or count > _MAX_ELEMENTS:
    raise ValueError(
      f'the model is too large: {_MAX_ELEMENTS} elements, nested '
      f'{_MAX_DEPTH} deep, are the most.'
    )
  for element in root.iter():
    if element.tag in _REFUSED:
      raise ValueError(
        f'the model has <{element.tag}>, which {_REFUSED[element.tag]}.'
      )
    for name, value in element.attrib.items():
      if any(map(_NOT_FINITE.fullmatch, value.split())):
        raise ValueError(
          f'<{element.tag}> has {name} {value!r:.40}, which is not finite.'
        )
    if element.tag == 'compiler' and 'settotalmass' in element.attrib:
      raise ValueError(
        'the compiler has settotalmass, which would change the arena as well.'
      )
    if element.tag == 'texture':
      for side in ('width', 'height'):
        value = element.get(side, '1')
        if not value.isdecimal() or not 0 < int(value) <= _MAX_TEXTURE:
          raise ValueError(
            f'a texture has {side} {value!r:.20}; {_MAX_TEXTURE} is the most.'
          )


def _leave_scenery(root: ElementTree.Element, trunk: str) -> None:
  """Leaves out what stands in the world beside the robot."""
  names = []
  for world in root.iter('worldbody'):
    for element in [part for part in world if part.tag in _SCENERY]:
      world.remove(element)
    names += [element.get('name', f'<{element.tag}>') for element in world]
  if names != [trunk]:
    raise ValueError(
      f'the only body of the world must be the trunk {trunk!r:.80}; the model '
      f'has {", ".join(names)[:200] or "none"}.'
    )


def _leave_visuals(root: ElementTree.Element) -> None:
  """Leaves out geoms that are for the eye alone, and their meshes.

  These touch nothing, are named by no pair or sensor, and make no body's mass.
  """
  import mujoco  # Late: all else here does without.

  used = {
    value
    for section in root
    if section.tag not in ('asset', 'default', 'worldbody')
    for element in section.iter()
    for value in element.attrib.values()
  }
  # Numbered in a copy, for most have no names; MuJoCo knows their classes.
  numbered = copy.deepcopy(root)
  for i, (_, geom) in enumerate(_body_geoms(numbered)):
    geom.set('name', str(i))
  try:
    text = ElementTree.tostring(numbered, encoding='unicode')
    spec = mujoco.MjSpec.from_string(text)
  except ValueError as error:
    reason = ' '.join(str(error).split())
    raise ValueError(f'the model is not MJCF: {reason:.300}') from None
  kinds = mujoco.mjtInertiaFromGeom
  inferred = spec.compiler.inertiafromgeom
  for i, (body, geom) in enumerate(_body_geoms(root)):
    known = spec.geom(str(i))
    weighs = inferred == kinds.mjINERTIAFROMGEOM_TRUE or (
      inferred == kinds.mjINERTIAFROMGEOM_AUTO
      and not known.parent.explicitinertial
    )
    mass = known.density if math.isnan(known.mass) else known.mass
    touches = known.contype or known.conaffinity
    if not (touches or weighs and mass or geom.get('name') in used):
      body.remove(geom)
  meshes = {geom.get('mesh') for geom in root.iter('geom')}
  for assets in root.iter('asset'):
    for mesh in assets.findall('mesh'):
      stem = pathlib.PurePosixPath(mesh.get('file', '')).stem
      if mesh.get('name', stem) not in meshes:
        assets.remove(mesh)


def _body_geoms(
  root: ElementTree.Element,
) -> list[tuple[ElementTree.Element, ElementTree.Element]]:
  """Returns the geoms of all bodies, each after its body."""
  return [
    (parent, geom)
    for world in root.iter('worldbody')
    for parent in world.iter()
    for geom in parent.findall('geom')
  ]
