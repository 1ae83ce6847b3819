"""Tests of dmc_multimode.bin.train_encoder."""

import pathlib
import re
import subprocess
import sys
from typing import Any
from unittest import mock

from absl import flags
from absl.testing import flagsaver
import pytest

from dmc_multimode.bin import train_encoder
from dmc_multimode.modes import library
from dmc_multimode.modes.encoder import mode_encoder
from dmc_multimode.modes.encoder import training as encoder_training

_MODE = """\
name: wait
kind: steady
duration: 0.9
keyframes:
- {phase: 0, position: [0, 0, 0.45]}
- {phase: 1, position: [0, 0, 0.45]}
"""


def _run(*args: str) -> subprocess.CompletedProcess[str]:
  command = [sys.executable, '-m', 'dmc_multimode.bin.train_encoder', *args]
  root = pathlib.Path(__file__).parents[2]
  return subprocess.run(
    command, capture_output=True, text=True, cwd=root, check=False
  )


def test_user_modes_train_beside_the_library(tmp_path: pathlib.Path) -> None:
  mode, out = tmp_path / 'wait.yaml', tmp_path / 'out'
  mode.write_text(_MODE)
  done = _run('--modes=walk_forward', f'--mode_file={mode}', f'--out={out}')
  assert done.returncode == 0, done.stderr
  book = mode_encoder.load(out).codebook()
  assert book.names == ('walk_forward', 'wait')
  for name in ('encoder.safetensors', 'encoder.json', 'encoding.png'):
    assert f'wrote {out / name}' in done.stdout
    assert (out / name).stat().st_size
  assert 'worst RMSE' in done.stderr
  assert 'RMSE of the base position' in done.stdout


@pytest.mark.parametrize(
  ('values', 'message'),
  [
    ({'mode_file': '/nowhere.yaml'}, '/nowhere.yaml'),
    ({'seed': -1}, 'seed'),
    ({'out': __file__}, 'train_encoder_test.py'),
    ({'out': None}, '--out'),
  ],
)
def test_bad_input_fails_before_training(
  tmp_path: pathlib.Path, values: dict[str, Any], message: str
) -> None:
  out = tmp_path / 'out'
  with (
    flagsaver.flagsaver(**{'out': str(out), **values}),
    mock.patch.object(encoder_training, 'train', side_effect=AssertionError),
    pytest.raises((ValueError, OSError), match=message),
  ):
    flags.FLAGS.mark_as_parsed()
    train_encoder.main(['train_encoder'])
  assert not out.exists()


def test_tables_and_figure() -> None:
  config = mode_encoder.EncoderConfig(max_rmse=0.5, min_separation=0.1)
  trained = encoder_training.train(library.resolve('pi2'), config)
  text = train_encoder.tables(trained)
  for name, error in trained.rmse().items():
    assert re.search(rf'{name} +{100 * error:.2f}', text)
    assert re.search(rf'\d {name}( +\d\.\d\d){{4}}', text)
  assert len(train_encoder.draw(trained).axes) == 3 * 4
