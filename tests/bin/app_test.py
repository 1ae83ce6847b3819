"""Tests for app: each command runs as a process, as a user's would."""

import pathlib
import subprocess
import sys

import pytest

from dmc_multimode.bin import app
from dmc_multimode.utils import resources

_ROOT = pathlib.Path(__file__).resolve().parents[2]
_BINARY = '''
import sys
sys.path.insert(0, {root!r})
from absl import flags
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.utils import config

@config.dataclass
class Config:
  """Things.

  Attributes:
    number: of things, kg.
  """

  number: config.PositiveInt = 3

_STEPS = flags.DEFINE_integer('steps', 1, 'Steps.')
flags.DEFINE_float('rate', 1.0, 'Rate.')
flags.DEFINE_enum('kind', 'a', ['a', 'b'], 'Kind.')
flags.DEFINE_bool('learn', False, 'Learns.')
config_flags.define(Config(), 'x')

def main(argv):
  {body}

app.run(main)
'''


class Binary:
  """A binary with a given body of `main`, run in an empty folder."""

  def __init__(self, folder: pathlib.Path) -> None:
    self.folder = folder

  def __call__(self, body: str, *args: str) -> subprocess.CompletedProcess[str]:
    script = self.folder / 'binary.py'
    script.write_text(_BINARY.format(root=str(_ROOT), body=body))
    return subprocess.run(
      [sys.executable, str(script), *args],
      cwd=self.folder,
      capture_output=True,
      text=True,
    )


@pytest.fixture
def binary(tmp_path: pathlib.Path) -> Binary:
  return Binary(tmp_path)


@pytest.mark.parametrize(('body', 'code'), [('pass', 0), ('return 3', 3)])
def test_return_value_is_the_exit_code(
  binary: Binary, body: str, code: int
) -> None:
  result = binary(body)
  assert (result.returncode, result.stderr) == (code, '')


@pytest.mark.parametrize(
  ('body', 'line'),
  [
    ('raise ValueError("no task x")', 'error: no task x'),
    ('raise ValueError("two\\n  lines")', 'error: two lines'),
    ('raise ValueError', 'error: ValueError'),
    ('open("gone.json")', 'error: No such file or directory: gone.json'),
    ('import no_such_extra', "error: No module named 'no_such_extra'"),
  ],
)
def test_expected_errors_are_one_line(
  binary: Binary, body: str, line: str
) -> None:
  result = binary(body)
  assert (result.returncode, result.stdout) == (2, '')
  assert result.stderr == f'{line}\n'


def test_traceback_at_debug_verbosity(binary: Binary) -> None:
  result = binary('raise ValueError("no task x")', '--verbosity=1')
  assert result.returncode == 2
  assert 'Traceback' in result.stderr
  assert result.stderr.endswith('error: no task x\n')


def test_bugs_and_interrupts(binary: Binary) -> None:
  result = binary('raise TypeError("ours")')
  assert result.returncode == 1
  assert 'Traceback' in result.stderr
  result = binary('raise KeyboardInterrupt')
  assert (result.returncode, result.stderr) == (130, 'interrupted\n')


def test_arguments_that_are_no_flags(binary: Binary) -> None:
  result = binary('print("ran")', 'quickstart')
  assert (result.returncode, result.stdout) == (2, '')
  assert "unexpected argument 'quickstart'" in result.stderr


@pytest.mark.parametrize(
  ('flag', 'line'),
  [
    ('--stepz=3', 'unknown flag --stepz: is it --steps? --help lists'),
    ('--number=3', 'unknown flag --number: is it --x_number? --help lists'),
    ('--unlike_any=3', 'unknown flag --unlike_any: --help lists all flags'),
    ('--steps=many', '--steps=many: give a whole number'),
    ('--rate=fast', '--rate=fast: give a number'),
    ('--kind=c', '--kind=c: give one of a|b'),
    ('--learn=maybe', '--learn=maybe: give true or false'),
    ('--x_number=0', '--x_number=0: Input should be greater than 0, got'),
    ('--steps', '--steps has no value: give --steps=VALUE'),
    ('--stderrthreshold=loud', '--stderrthreshold must be one of'),
    (f'--flagfile={sys.executable}', "'utf-8' codec can't decode"),
    (
      '--task_push_speed=0.5',
      '--task_push_speed is now --task_events_push_speed=0:SPEED@START',
    ),
    ('--noppo_compile', '--noppo_compile is gone: torch.compile made'),
  ],
)
def test_wrong_flags(binary: Binary, flag: str, line: str) -> None:
  result = binary('print("ran")', flag)
  assert (result.returncode, result.stdout) == (2, '')
  assert result.stderr.startswith(f'error: {line}')
  assert result.stderr.count('\n') == 1


def test_a_flag_that_is_needed(binary: Binary) -> None:
  needed = 'pass\nflags.DEFINE_string("out", None, "Where to.", required=True)'
  result = binary(needed)
  assert (result.returncode, result.stdout) == (2, '')
  assert result.stderr == 'error: --out is needed: Where to.\n'


@pytest.mark.parametrize(
  'flag', ['--help', '-help', '--helpshort', '-?', '--helpfull']
)
def test_help_has_the_flags_of_configurations(
  binary: Binary, flag: str
) -> None:
  result = binary('print("ran")', flag)
  assert (result.returncode, result.stderr) == (0, '')
  assert 'ran' not in result.stdout
  assert (
    "--steps: Steps.\n    (default: '1')\n    (an integer)" in result.stdout
  )
  assert (
    '\n--x_*: Things:\n  --x_number: of things, kg.\n'
    "    (default: '3')\n    (a whole number above 0)\n"
  ) in result.stdout


def test_help_is_no_value_and_no_argument(binary: Binary) -> None:
  result = binary('print("ran", argv)', '--', '--help')
  assert (result.returncode, result.stdout) == (2, '')
  assert "unexpected argument '--help'" in result.stderr


def test_help_that_is_cut_off() -> None:
  command = f'{sys.executable} -m dmc_multimode.bin.curves --help | head -n 1'
  done = subprocess.run(
    command, shell=True, cwd=_ROOT, capture_output=True, text=True
  )
  assert (done.stdout.count('\n'), done.stderr) == (1, '')


@pytest.mark.parametrize('name', ['curves', 'train'])
def test_help_of_a_console_script(name: str, tmp_path: pathlib.Path) -> None:
  """The same as of `python -m`, but for the name."""
  script = tmp_path / f'dmc-multimode-{name}'
  script.write_text(
    f'import sys\nsys.path.insert(0, {str(_ROOT)!r})\n'
    f'from dmc_multimode.bin.{name} import cli\ncli()\n'
  )
  module = 'dmc_multimode.bin.' + name
  shown = []
  for program in (['-m', module], [str(script)]):
    done = subprocess.run(
      [sys.executable, *program, '--help'],
      cwd=_ROOT,
      capture_output=True,
      text=True,
    )
    assert (done.returncode, done.stderr) == (0, '')
    shown.append([n for n in done.stdout.splitlines() if name not in n])
  assert shown[0] == shown[1]
  assert '_dir' in ''.join(shown[0]) or '--out' in ''.join(shown[0])


@pytest.mark.parametrize(
  ('name', 'flag'),
  [
    ('train', '--modes=walk_forwrd'),
    ('train', '--init_from=pi2 --modes=walk_forwrd'),
    ('train_encoder', '--modes=walk_forwrd'),
    ('record', '--policy=pi2 --schedule=walk_forwrd:1'),
  ],
)
def test_a_typo_is_found_before_anything_slow_is_imported(
  name: str, flag: str, tmp_path: pathlib.Path
) -> None:
  code = f"""if True:
    import sys
    class Slow:
      def find_spec(self, name, *args):
        assert name not in ('torch', 'dm_control', 'matplotlib'), name
    sys.meta_path.insert(0, Slow())
    sys.path.insert(0, {str(_ROOT)!r})
    from dmc_multimode.bin import {name}
    {name}.cli()"""
  where = {'train': '--run_dir=run', 'record': '--out=x.mp4'}
  command = [sys.executable, '-c', code, *flag.split()]
  done = subprocess.run(
    [*command, where.get(name, '--out=encoder')],
    cwd=tmp_path,
    capture_output=True,
    text=True,
  )
  assert done.returncode == 2
  assert done.stderr.startswith("error: Unknown mode 'walk_forwrd'")
  assert done.stderr.count('\n') == 1 and not list(tmp_path.iterdir())


@pytest.fixture
def shipped(
  tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> pathlib.Path:
  """An installation that ships `flags/shipped.flags`; an empty folder as cwd.

  Returns:
    The path of that flagfile.
  """
  package = tmp_path / 'site' / 'dmc_multimode'
  flagfile = package / 'flags' / 'shipped.flags'
  flagfile.parent.mkdir(parents=True)
  flagfile.write_text('--steps=7\n')
  monkeypatch.setattr(resources, '_PACKAGE', package)
  empty = tmp_path / 'empty'
  empty.mkdir()
  monkeypatch.chdir(empty)
  return flagfile


@pytest.mark.parametrize(
  'args',
  [
    ['--flagfile=flags/shipped.flags'],
    ['-flagfile', './flags/shipped.flags'],
  ],
)
def test_packaged_flagfile(shipped: pathlib.Path, args: list[str]) -> None:
  assert app.find_flagfiles(['train', '--a=1', *args, '--b']) == [
    'train',
    '--a=1',
    f'--flagfile={shipped}',
    '--b',
  ]


def test_what_is_left_alone(shipped: pathlib.Path) -> None:
  del shipped
  for args in (['--flagfiles=x', '--', '--flagfile=gone'], ['--flagfile']):
    assert app.find_flagfiles(['train', *args]) == ['train', *args]
  own = pathlib.Path('flags/shipped.flags')  # What exists comes first.
  own.parent.mkdir()
  own.touch()
  args = ['train', '--flagfile=flags/shipped.flags']
  assert app.find_flagfiles(args) == args


@pytest.mark.parametrize(
  'value',
  [
    'gone.flags',
    'flags/../flags/shipped.flags',
    '/flags/shipped.flags',
  ],
)
def test_missing_flagfile(shipped: pathlib.Path, value: str) -> None:
  del shipped
  with pytest.raises(FileNotFoundError, match='shipped.flags'):
    app.find_flagfiles(['train', f'--flagfile={value}'])


def test_missing_flagfile_as_a_command(binary: Binary) -> None:
  result = binary('print("ran")', '--flagfile=flags/gone.flags')
  assert (result.returncode, result.stdout) == (2, '')
  [line] = result.stderr.splitlines()
  assert line.startswith('error: no flags')
  assert 'gone.flags' in line


def test_flags_of_a_flagfile_are_read(
  binary: Binary, tmp_path: pathlib.Path
) -> None:
  (tmp_path / 'own.flags').write_text('--steps=7\n')
  result = binary('print(_STEPS.value)', '--flagfile=own.flags')
  assert (result.returncode, result.stdout) == (0, '7\n')


def test_packaged_flagfiles_include_no_others() -> None:
  """absl would look for an included one in the user's folder alone."""
  for name in resources.names('flags'):
    assert '--flagfile' not in resources.path('flags', name).read_text(), name
