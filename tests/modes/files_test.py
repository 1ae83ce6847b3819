"""Tests of dmc_multimode.modes.files and fields."""

import copy
import json
import pathlib
import re
from typing import Any, Callable

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.modes import motion as motion_lib

_YAML = """\
name: turn_left
kind: periodic
duration: 0.9  # seconds
takeoff: 0.25
mirror: turn_right
half_cycle_symmetric: true
step: {edge: 0.3, height: -0.1}
keyframes:
  - phase: 0
    position: [0, 0, 0.5]
    contacts: [1, 0]
  - phase: 5e-1
    position: [0.1, 0, 0.5]
    euler: [0, 0, 45]
    contacts: [0, 1]
  - phase: 1
    position: [0.2, 0, .5]
    orientation: [2, 0, 0, 2]
    contacts: [true, false]
"""
_CUT = 'name: a\nkind: steady\nduration: 1\n'
_ITEM = '  -\n' + ''.join(f'    {line}\n' for line in _YAML.splitlines())


def _assert_equal(
  one: motion_lib.ReferenceMotion, other: motion_lib.ReferenceMotion
) -> None:
  """Asserts equality of every field, to the last bit."""
  for field in vars(one):
    wanted, found = getattr(one, field), getattr(other, field)
    np.testing.assert_array_equal(found, wanted, err_msg=field)


def _random_motion(seed: int) -> motion_lib.ReferenceMotion:
  rng = np.random.default_rng(seed)
  size = int(rng.integers(2, 9))
  phases = np.concatenate([[0.0], np.sort(rng.random(size - 2)), [1.0]])
  return motion_lib.ReferenceMotion(
    name=f'random_{seed}',
    kind=motion_lib.TRANSIENT,
    duration=rng.uniform(0.01, 5),
    phases=phases,
    positions=rng.normal(size=(size, 3)),
    orientations=rng.normal(size=(size, 4)),
    contacts=rng.integers(0, 2, (size, 2)) if rng.random() < 0.5 else None,
    ledge=motion_lib.Ledge(*rng.normal(size=2)),
    takeoff=rng.random(),
  )


Write = Callable[..., pathlib.Path]


@pytest.fixture(scope='module')
def write(tmp_path_factory: pytest.TempPathFactory) -> Write:
  """Writes a file of one folder and returns its path."""
  folder = tmp_path_factory.mktemp('modes')

  def write_file(text: str | bytes, name: str = 'modes.yaml') -> pathlib.Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path

  return write_file


def _fails(path: pathlib.Path, where: str, message: str) -> None:
  with pytest.raises(mode_files.ModeFileError) as caught:
    mode_files.load(path)
  text = str(caught.value)
  assert text.startswith(f'{path}:{where}')
  assert re.search(message, text)
  assert '\n' not in text


def test_every_field(write: Write) -> None:
  (motion,) = mode_files.load(write(_YAML))
  wanted = motion_lib.ReferenceMotion(
    name='turn_left',
    kind=motion_lib.PERIODIC,
    duration=0.9,
    phases=np.array([0, 0.5, 1]),
    positions=np.array([[0, 0, 0.5], [0.1, 0, 0.5], [0.2, 0, 0.5]]),
    orientations=motion.orientations,
    contacts=np.array([[1, 0], [0, 1], [1, 0]]),
    ledge=motion_lib.Ledge(0.3, -0.1),
    takeoff=0.25,
    mirror='turn_right',
    half_cycle_symmetric=True,
  )
  _assert_equal(motion, wanted)
  yaw = np.degrees(motion_lib.yaw(motion.orientations))
  np.testing.assert_allclose(yaw, [0, 45, 90], atol=1e-9)
  # Roll, then pitch, then yaw: x stays in the roll and becomes y in the yaw.
  text = _YAML.replace('[0, 0, 45]', '[90, 0, 90]')
  (motion,) = mode_files.load(write(text))
  np.testing.assert_allclose(motion.orientations[1], [0.5] * 4, atol=1e-12)


def test_optional_fields_have_defaults(write: Write) -> None:
  frames = (
    '[{phase: 0, position: [0, 0, .6]}, {phase: 1, position: [0, 0, .6]}]'
  )
  (motion,) = mode_files.load(
    write(f'{{name: a, kind: steady, duration: 1, keyframes: {frames}}}')
  )
  assert (motion.contacts, motion.ledge, motion.mirror) == (None, None, 'a')
  np.testing.assert_array_equal(motion.orientations, [[1, 0, 0, 0]] * 2)


def test_whole_library_as_json(write: Write) -> None:
  motions = tuple(library.modes().values())
  data = {'modes': [mode_files.motion_to_dict(m) for m in motions]}
  path = write(json.dumps(data, indent='\t'), 'modes.json')
  for wanted, found in zip(motions, mode_files.load(path), strict=True):
    _assert_equal(wanted, found)


@pytest.mark.parametrize('seed', range(20))
def test_dict_round_trip_is_exact(seed: int) -> None:
  motion = _random_motion(seed)
  data = json.loads(json.dumps(mode_files.motion_to_dict(motion)))
  _assert_equal(motion, mode_files.motion_from_dict(data))
  data['keyframes'][1]['position'] = [0, 0]
  with pytest.raises(
    mode_files.ModeFileError, match=r'^keyframes\[1\].position: .* 3 items'
  ):
    mode_files.motion_from_dict(data)


@pytest.mark.parametrize(
  ('old', 'new', 'line', 'message'),
  [
    ('name: turn_left', 'name: a b', 1, 'letters'),
    ('name: turn_left', 'name: 7', 1, 'name .* string'),
    ('name: turn_left', 'name: pi2', 1, 'mode set'),
    ('name: turn_left', 'nome: turn_left', 1, "unknown field 'nome'.*name"),
    ('name: turn_left\n', '', 1, "'name' is missing"),
    ('periodic', 'sometimes', 2, "kind .*'transient'"),
    ('periodic', 'steady', 8, 'steady'),
    ('0.9 ', '-0.9 ', 3, 'duration .* 0.001'),
    ('0.9 ', '.nan ', 3, 'number'),
    ('0.9 ', ' ', 3, 'number.*None'),
    ('takeoff: 0.25', 'takeoff: 2', 4, 'takeoff .* 1,'),
    ('turn_right', '[a]', 5, 'mirror'),
    ('true\n', 'yes please\n', 6, 'half_cycle.* boolean'),
    ('edge: 0.3, ', '', 7, "'edge' is missing"),
    ('{edge: 0.3, height: -0.1}', '3', 7, 'edge, height'),
    ('phase: 0\n', 'phase: 0.1\n', 9, 'first phase'),
    # Every command would be lost at once.
    ('[0, 0, 0.5]', '[0.36, 0, 0.5]', 9, r'0.36 m from .* at most 0.35 m'),
    ('[1, 0]', '[1, 0]\n    euler: [0, 0, 60]', 9, '1.05 rad .* at most 1 rad'),
    ('[0, 0, 0.5]', '[0, 0]', 10, 'position .* 3 items'),
    ('[0, 0, 0.5]', '\n    - 0\n    - x\n    - 1', 12, 'number'),
    ('    contacts: [1, 0]\n', '', 9, 'missing here'),
    ('[1, 0]', '[1, 2]', 11, '0 or 1'),
    ('[1, 0]', '[1, 0]\n    contacts: [1, 0]', 12, 'twice'),
    ('phase: 5e-1', 'phase: 0', 12, 'rise'),
    ('phase: 1\n', 'phase: 0.9\n', 16, 'last phase'),
    ('euler: [0', 'orientation: [1, 0, 0, 0]\n    euler: [0', 15, 'not both'),
    ('[2, 0, 0, 2]', '[0, 0, 0, 0]', 18, 'zero'),
    ('takeoff: 0.25', '? [a]\n: 1', 4, 'plain text'),
    ('takeoff: 0.25', '<<: {a: 1}', 4, 'unknown'),
    ('takeoff: 0.25', 'takeoff: !!python/name:os.system', 4, 'not allowed'),
    ('takeoff: 0.25', 'takeoff: &a 0.25\nmirror: *a', 5, 'aliases'),
    ('takeoff: 0.25', f'takeoff: {"[" * 50}', 4, 'deep'),
    ('takeoff: 0.25', 'takeoff: [', 6, 'expected'),
    ('takeoff: 0.25', 'takeoff: \x00', 4, r'U\+0000'),
    ('takeoff: 0.25', '---\n{}', 4, 'document'),
    (_YAML, '', 1, 'empty'),
    (_YAML, '# nothing\n', 1, 'empty'),
    (_YAML, 'modes: []', 1, 'at least 1'),
    (_YAML, 'modes: 3', 1, 'list'),
    (_YAML, '\nmodes:\n- 3', 3, 'fields name'),
    (_YAML, '- 3', 1, 'fields name'),
    (_YAML, 'just text', 1, 'fields name'),
    (_YAML, f'modes:\n{_ITEM}{_ITEM}', 23, "'turn_left' is given"),
    (_YAML, _CUT + f'keyframes: [{"{}," * 1001}]', 4, 'at most 1000'),
  ],
)
def test_names_the_line(
  write: Write, old: str, new: str, line: int, message: str
) -> None:
  assert old in _YAML
  _fails(write(_YAML.replace(old, new, 1)), f'{line}: ', message)


@pytest.mark.parametrize(
  ('content', 'name', 'where', 'message'),
  [
    (b'name: a\nkind: \xff', 'a.yaml', '2: ', 'UTF-8'),
    (b'{\n"name": 3,\n}', 'a.JSON', '3: ', 'not JSON'),
    (b'{"a": ' + b'[' * 100_000, 'a.JSON', '', 'deep'),
    (b'{"duration": ' + b'1' * 5000, 'a.JSON', '1: ', 'too long|JSON'),
    (b' ' * (mode_files.MAX_BYTES + 1), 'a.yaml', ' ', 'too large'),
  ],
)
def test_other_content(
  write: Write, content: bytes, name: str, where: str, message: str
) -> None:
  path = write(content, name)
  _fails(path, where, message)
  _fails(path.with_name('none.yaml'), ' ', 'No such file')
  _fails(path.parent, ' ', 'directory')


_SCALARS = st.one_of(
  st.none(),
  st.booleans(),
  st.integers(),
  st.floats(),
  st.text(max_size=5),
  st.sampled_from(['periodic', 'steady', 'pi2', 0, 1, 1e300]),
)
_VALUES = st.recursive(
  _SCALARS,
  lambda inner: st.one_of(
    st.lists(inner, max_size=4),
    st.dictionaries(st.text(max_size=5), inner, max_size=3),
  ),
  max_leaves=6,
)


def _places(data: Any) -> list[tuple[Any, Any]]:
  """Returns (container, key) of every value inside `data`."""
  places = []
  if isinstance(data, (dict, list)):
    for key in data if isinstance(data, dict) else range(len(data)):
      places.append((data, key))
      places += _places(data[key])
  return places


def _only_mode_file_errors(path: pathlib.Path) -> None:
  try:
    mode_files.load(path)
  except mode_files.ModeFileError as error:
    assert str(error).startswith(str(path))
    assert len(str(error).splitlines()) == 1


@hypothesis.settings(max_examples=150, deadline=None, derandomize=True)
@hypothesis.given(st.binary(max_size=80), st.sampled_from(['yaml', 'json']))
def test_bytes(write: Write, content: bytes, kind: str) -> None:
  _only_mode_file_errors(write(content, f'a.{kind}'))


@hypothesis.settings(max_examples=150, deadline=None, derandomize=True)
@hypothesis.given(
  st.integers(0, len(_YAML)),
  st.integers(0, 5),
  st.text('[]{}:,-?&*!|>\'"%@#\n\t 01aE.\\ux\u2028', max_size=6),
)
def test_edits(write: Write, start: int, cut: int, text: str) -> None:
  edited = _YAML[:start] + text + _YAML[start + cut :]
  _only_mode_file_errors(write(edited))


@pytest.mark.slow
@hypothesis.settings(max_examples=200, deadline=None, derandomize=True)
@hypothesis.given(st.data())
def test_values(write: Write, data: st.DataObject) -> None:
  mode = copy.deepcopy(mode_files.motion_to_dict(_random_motion(1)))
  places = _places(mode)
  container, key = places[data.draw(st.integers(0, len(places) - 1))]
  container[key] = data.draw(_VALUES)
  try:
    mode_files.motion_from_dict(mode)
  except mode_files.ModeFileError as error:
    assert len(str(error).splitlines()) == 1
  path = write(json.dumps(mode), 'a.json')
  _only_mode_file_errors(path)


def test_contacts_of_four_feet(tmp_path: pathlib.Path) -> None:
  path = tmp_path / 'mode.yaml'
  text = _YAML.replace('[1, 0]', '[1, 0, 0, 1]')
  text = text.replace('[0, 1]', '[0, 1, 1, 0]')
  path.write_text(text.replace('[true, false]', '[1, 1, 1, 1]'))
  (motion,) = mode_files.load(path)
  assert motion.num_feet == 4
  again = mode_files.motion_from_dict(mode_files.motion_to_dict(motion))
  _assert_equal(motion, again)
  path.write_text(text)
  with pytest.raises(
    mode_files.ModeFileError, match='are of 2 feet, before of'
  ):
    mode_files.load(path)


def test_units_of_the_standing_height_fit_any_robot(
  tmp_path: pathlib.Path,
) -> None:
  """h = 1 m: lengths are metres, and times seconds over sqrt(9.81)."""
  path = tmp_path / 'mode.yaml'
  path.write_text(
    """
name: jump
kind: transient
units: height
duration: 4
step: {edge: 0.5, height: 0.8}
keyframes:
  - {phase: 0, position: [0, 0, 1]}
  - {phase: 1, position: [1.2, 0, 1.8]}
"""
  )
  (large,) = mode_files.load(path, stand_height=1.0)
  assert large.duration == pytest.approx(4 / 9.81**0.5)
  assert large.positions.tolist() == [[0, 0, 1], [1.2, 0, 1.8]]
  (small,) = mode_files.load(path)
  assert small.duration == pytest.approx(4 * (0.5 / 9.81) ** 0.5)
  assert small.positions.tolist() == [[0, 0, 0.5], [0.6, 0, 0.9]]
  assert small.ledge == motion_lib.Ledge(0.25, 0.4)


def test_a_mode_in_metres_begins_where_its_robot_stands(
  tmp_path: pathlib.Path,
) -> None:
  path = tmp_path / 'mode.yaml'
  path.write_text(
    """
name: still
kind: steady
duration: 1
keyframes:
  - {phase: 0, position: [0, 0, 1]}
  - {phase: 1, position: [0, 0, 1]}
"""
  )
  assert mode_files.load(path, stand_height=1.0)
  with pytest.raises(mode_files.ModeFileError, match=r'from \(0, 0, 0.5\)'):
    mode_files.load(path)
