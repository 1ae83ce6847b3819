r"""Exports a policy as ONNX, or robot and track as one MuJoCo model.

  python -m dmc_multimode.bin.export --policy=pi2 --out=out/pi2.onnx

writes the policy, checked against torch; out/pi2.json, which has all that a
controller needs to know of it, as the model's metadata do; and
out/controller.py, a controller in numpy and onnxruntime.

  python -m dmc_multimode.bin.export --format=mjcf --arena=block \
    --sizes=distance:6 --out=out

writes out/mini_biped_block.xml, which any MuJoCo program opens. See
docs/DEPLOY.md, and examples/deploy_mujoco.py, which runs the one in the other.
"""

import itertools
import pathlib
from typing import Sequence

from absl import flags

from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.utils import files

_POLICY = config_flags.define_path(
  'policy', 'pi2', 'Name of a shipped policy, or folder of a policy or a run.'
)
_ROBOT = config_flags.define_robot()
_FORMAT = flags.DEFINE_enum(
  'format', 'onnx', ['onnx', 'mjcf'], 'A policy, or robot and track.'
)
_OUT = config_flags.define_path(
  'out', None, 'The .onnx file to write; of a model the folder.'
)
# Of a model.
_ARENA = flags.DEFINE_string('arena', 'flat', 'Of a model: its track.')
_SIZES = config_flags.define_sizes()
_SEED = flags.DEFINE_integer('seed', 0, 'Of a model: of a random track.')
_TIMESTEP = flags.DEFINE_float(
  'physics_timestep', None, "Of a model: seconds; the tasks' own by default."
)
_OF = {
  'onnx': ('policy', 'robot'),
  'mjcf': ('arena', 'sizes', 'seed', 'physics_timestep', 'robot'),
}


def _write_policy(out: pathlib.Path) -> None:
  """Writes a policy and its description."""
  # Late, as these import torch.
  from dmc_multimode import pretrained
  from dmc_multimode.deployment import onnx_export

  policy = pretrained.load(_POLICY.value, robot=_ROBOT.value or None)
  apart = onnx_export.write(policy, out)
  print(f'greatest difference from torch: {apart:.2e} rad')
  beside = out.with_name(onnx_export.CONTROLLER)
  for path in (out, out.with_suffix('.json'), beside):
    print(f'wrote {path} ({path.stat().st_size} bytes)')


def _write_model(out: pathlib.Path) -> None:
  """Writes robot and track."""
  from dmc_multimode.deployment import mjcf_export

  path = mjcf_export.write(
    out,
    _ARENA.value,
    config_flags.read_sizes(_SIZES.value),
    _SEED.value,
    _TIMESTEP.value,
    _ROBOT.value or None,
  )
  print(f'wrote {path} ({path.stat().st_size} bytes)')


def main(argv: Sequence[str]) -> None:
  """Checks the flags and writes; `argv` holds no flags."""
  del argv
  kind = _FORMAT.value
  for name in itertools.chain(*_OF.values()):
    if name not in _OF[kind] and flags.FLAGS[name].present:
      raise ValueError(f'--{name} says nothing of --format={kind}.')
  check, write, what = {
    'onnx': (files.output_file, _write_policy, 'FILE.onnx'),
    'mjcf': (files.output_folder, _write_model, 'FOLDER'),
  }[kind]
  out = check('out', _OUT.value)
  if out is None:
    raise ValueError(f'Say what to write: --out={what}.')
  write(out)


def cli() -> None:
  """Console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
