"""Common entry point of the commands: flags, errors, exit codes.

A command is a module `dmc_multimode/bin/NAME.py` of this form; its console
script `dmc-multimode-NAME` in `setup.cfg` points at `cli`:

    def main(argv: Sequence[str]) -> None:
      ...

    def cli() -> None:
      app.run(main)

    if __name__ == '__main__':
      cli()

A command that renders calls `gl.choose_backend()` first thing in `main` and
imports whatever imports dm_control after that, inside `main`.

Exit codes: 0 success; 1 a bug (with a traceback); 2 an error that the user can
mend, flags included (one line `error: ...` on stderr, and the traceback with
`--verbosity=1`); 3 no plan reaches the goal; 130 interrupted.
"""

import difflib
import functools
import os
import pathlib
import re
import sys
import traceback
import types
from typing import Callable, NoReturn, Sequence

from absl import app as absl_app
from absl import flags
from absl import logging
import pydantic

from dmc_multimode.bin import flags as config_flags
from dmc_multimode.utils import config
from dmc_multimode.utils import resources

Main = Callable[[Sequence[str]], int | None]
Step = Callable[[], None]

EXIT_ERROR = 2
EXIT_UNSOLVED = 3
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as in shells.

# Errors of inputs, missing files and missing extras. Others are bugs, with a
# traceback.
EXPECTED_ERRORS = (
  ValueError,  # Names, numbers, schedules, malformed or foreign files.
  OSError,  # Files that are missing or not writable; no GL library.
  FloatingPointError,  # The NaN guard of a learner.
  ModuleNotFoundError,  # An extra that is not installed.
)

# `--helpfull` is absl's own: it adds the flags of absl.
_HELP = ('help', 'helpshort', '?')
# Reasons for which absl refuses a value -> what to give in its place.
_REASONS = (
  (r'flag (--.*?): invalid literal for int\(\).*', r'\1: give a whole number'),
  (r'flag (--.*?): could not convert string to float.*', r'\1: give a number'),
  (r'flag (--.*?): .*Non-boolean argument.*', r'\1: give true or false'),
  (r'flag (--.*?): value should be one of <(.*)>', r'\1: give one of \2'),
  (r'flag (--.*)', r'\1'),
  (r'Missing value for flag (--\w+).*', r'\1 has no value: give \1=VALUE'),
)
_REQUIRED = re.compile(r'Flag --(\w+) must have a value other than None')
_FLAGFILE = re.compile(r'--?flagfile(=(?P<value>.*))?', re.DOTALL)


def run(
  main: Main,
  argv: Sequence[str] | None = None,
  check: Step | None = None,
  define: Step = lambda: None,
) -> NoReturn:
  """Parses the flags, calls `main` and exits; see the module's docstring.

  `--flagfile=flags/NAME.flags` is the packaged flagfile if there is no such
  path, so that commands are the same in a checkout and elsewhere.

  Args:
    main: Receives the program's name only: positional arguments are an error.
      Returns the exit code, None for 0.
    argv: Command line, program name first; `sys.argv` if None.
    check: Raises what is wrong with the flags that are defined so far, before
      slow imports.
    define: Defines the others, whose defaults take these imports.
  """
  try:
    args = find_flagfiles(sys.argv if argv is None else argv)
  except FileNotFoundError as error:
    sys.exit(_report(error))
  if check and not _words(args) & {*_HELP, 'helpfull', 'helpxml'}:
    _parse_flags(args, known_only=True)
    try:
      check()
    except EXPECTED_ERRORS as error:
      sys.exit(_report(error))
    flags.FLAGS.unparse_flags()
  define()
  _lend_help(sys.modules[main.__module__])
  if _words(args) & {*_HELP}:
    sys.exit(_print_help())
  absl_app.run(
    functools.partial(_guard, main), argv=args, flags_parser=_parse_flags
  )
  raise AssertionError('absl.app.run returned')


def _lend_help(module: types.ModuleType) -> None:
  """Makes `--help` of a console script show the command's text and flags.

  absl takes both from the main module, which is a stub there.
  """
  sys.modules['__main__'].__doc__ = module.__doc__
  for flag in flags.FLAGS.get_flags_for_module(module.__name__):
    flags.FLAGS.register_key_flag_for_module(sys.argv[0], flag)


def _words(args: Sequence[str]) -> set[str]:
  """Returns the names of the flags in a command line that have no value."""
  last = args.index('--') if '--' in args else len(args)
  return {arg.lstrip('-') for arg in args[1:last] if arg.startswith('-')}


def _print_help() -> int:
  """Prints the command's text, its flags and those of its configurations.

  absl's own `--help` leaves out the latter.
  """
  text = [
    (sys.modules['__main__'].__doc__ or '').strip(),
    '\nflags:',
    flags.FLAGS.main_module_help(),
    *config_flags.help_texts(),
    "\n--helpfull lists absl's own flags, too.",
  ]
  try:
    print('\n'.join(text), flush=True)
  except BrokenPipeError:  # As of `--help | head`.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
  return 0


def _parse_flags(args: Sequence[str], known_only: bool = False) -> list[str]:
  """Parses the flags; errors are one line with exit code 2."""
  try:
    rest: list[str] = flags.FLAGS(args, known_only)
    return rest
  except SystemExit:
    sys.exit(0)  # After `--help`, which absl ends with 1.
  # absl lets pass what a flagfile's bytes or a flag of its own raise.
  except (flags.Error, ValueError, OSError) as error:
    sys.exit(_report(_explained(error)))


def _explained(error: Exception) -> Exception:
  """Returns an error of flags that says what to do."""
  if isinstance(error, flags.UnrecognizedFlagError):
    return flags.Error(_unknown(error.flagname))
  text = str(error)
  missing = _REQUIRED.findall(text)
  if missing:
    texts = (
      f'--{name} is needed: {flags.FLAGS[name].help}' for name in missing
    )
    return flags.Error(' '.join(texts))
  if isinstance(error, flags.Error):
    for pattern, replacement in _REASONS:
      if match := re.fullmatch(pattern, text, re.DOTALL):
        return flags.Error(match.expand(replacement))
  return error


def _unknown(name: str) -> str:
  """Returns what to do about a flag that there is not."""
  if name in config_flags.RENAMED:
    return f'--{name} is now --{config_flags.RENAMED[name]}'
  reason = config_flags.REMOVED.get(name.removeprefix('no'))
  if reason:
    return f'--{name} is gone: {reason}'
  known = [other for other in flags.FLAGS if other.endswith(f'_{name}')]
  known = known or difflib.get_close_matches(name, [*flags.FLAGS])
  names = ' or '.join(f'--{other}' for other in known)
  hint = f'is it {names}? ' if known else ''
  return f'unknown flag --{name}: {hint}--help lists all flags'


def find_flagfiles(argv: Sequence[str]) -> list[str]:
  """Replaces `flags/NAME.flags` by the packaged file where it is not a path.

  Args:
    argv: Command line, in any of absl's spellings of `--flagfile`.

  Returns:
    A command line for absl, otherwise unchanged.

  Raises:
    FileNotFoundError: If a flagfile is neither a path nor packaged.
  """
  found: list[str] = []
  args = iter(argv)
  for arg in args:
    match = _FLAGFILE.fullmatch(arg)
    if match:
      value = match['value'] if match['value'] is not None else next(args, None)
      arg = arg if value is None else f'--flagfile={_flagfile(value)}'
    found.append(arg)
    if arg == '--':  # absl stops parsing here.
      found.extend(args)
  return found


def _flagfile(value: str) -> str:
  """Returns the path of a flagfile, or that of the packaged one."""
  path = pathlib.Path(value.strip()).expanduser()
  if path.exists() and not path.is_dir():
    return value
  if path.parent == pathlib.Path('flags') and path.suffix == '.flags':
    return str(resources.path('flags', path.name))
  shipped = ', '.join(f'flags/{name}' for name in resources.names('flags'))
  raise FileNotFoundError(f'no flagfile {value!r}; there is: {shipped}')


def _guard(main: Main, argv: Sequence[str]) -> int:
  """Calls `main`; returns the exit code of its errors."""
  if logging.get_verbosity() == logging.INFO:
    logging.set_verbosity(logging.WARNING)  # dm_control greets at INFO.
  try:
    if len(argv) > 1:
      raise ValueError(f'unexpected argument {argv[1]!r}: use --flag=value')
    return main(argv) or 0
  except EXPECTED_ERRORS as error:
    if logging.get_verbosity() >= logging.DEBUG:
      traceback.print_exc()
    return _report(error)
  except KeyboardInterrupt:
    print('interrupted', file=sys.stderr)
    return EXIT_INTERRUPTED


def _report(error: Exception) -> int:
  """Prints an error as one line; returns the exit code."""
  text = str(error)
  if isinstance(error, pydantic.ValidationError):
    text = config.describe(error)
  if isinstance(error, OSError) and error.strerror and error.filename:
    text = f'{error.strerror}: {error.filename}'
  lines = [line.strip() for line in text.splitlines() if line.strip()]
  print('error:', ' '.join(lines) or type(error).__name__, file=sys.stderr)
  return EXIT_ERROR
