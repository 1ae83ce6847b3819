r"""Serves a browser page that shows and commands a policy.

  python -m dmc_multimode.bin.view --policy=pi2 --arena=gap_block

On --arena=endless obstacles of --difficulty appear ahead for as long as the
robot runs; with --selector=FOLDER a selector of `train_selector` commands it,
until somebody does.

Buttons and keys command modes, push the robot, choose the track, and search for
a plan across it. --action_delay=0.03, --payload=2 and their like fix what is
wrong with the robot, as for `evaluate`. The page is reachable from this machine
only, unless --host is given: everyone who reaches it can command the robot.
Ctrl-C ends it.

--viewer=native opens dm_control's own viewer, which needs a display.
"""

from typing import Sequence

from absl import flags

from dmc_multimode import viewer
from dmc_multimode.arenas import layouts
from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags

_POLICY = config_flags.define_path(
  'policy', 'pi2', 'Name of a shipped policy, or folder of a policy or a run.'
)
_ROBOT = config_flags.define_robot()
_ARENA = flags.DEFINE_string(
  'arena', 'flat', f'{", ".join(layouts.NAMES)} or endless.'
)
_SELECTOR = config_flags.define_path(
  'selector', None, 'Folder of a selector, which then commands the robot.'
)
_DIFFICULTY = flags.DEFINE_float(
  'difficulty', 0.5, 'Of the endless track, 0 to 1.', 0.0, 1.0
)
_SEED = flags.DEFINE_integer('seed', 0, 'Of the track and the initial state.')
_VIEWER = flags.DEFINE_enum(
  'viewer', 'web', ['web', 'native'], 'A page, or a window.'
)
_HOST = flags.DEFINE_string(
  'host', '127.0.0.1', 'Address of this machine at which the page is served.'
)
_PORT = flags.DEFINE_integer('port', 8080, 'Of the page; 0 for any free one.')
_THREADS = flags.DEFINE_integer(
  'threads', 1, 'Of the planner; the robot needs a core.', lower_bound=1
)
config_flags.define_disturbances()


def main(argv: Sequence[str]) -> None:
  """Shows the policy until it is interrupted; `argv` holds no flags."""
  del argv
  viewer.view(
    _POLICY.value,
    _ARENA.value,
    _SEED.value,
    _HOST.value,
    _PORT.value,
    _THREADS.value,
    native=_VIEWER.value == 'native',
    disturbed=config_flags.given_disturbances(),
    selector=_SELECTOR.value,
    difficulty=_DIFFICULTY.value,
    robot=_ROBOT.value or None,
  )


def cli() -> None:
  """Runs as a console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
