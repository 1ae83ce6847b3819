"""Tests of dmc_multimode.bin.train_encoder."""

import pathlib
import subprocess
import sys
import tempfile
from typing import Any
from unittest import mock

from absl import flags
from absl.testing import absltest
from absl.testing import flagsaver
from absl.testing import parameterized

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


class TrainEncoderTest(parameterized.TestCase):
  def setUp(self) -> None:
    super().setUp()
    temporary = tempfile.TemporaryDirectory()
    self.addCleanup(temporary.cleanup)
    self.folder = pathlib.Path(temporary.name)

  def test_user_modes_train_beside_the_library(self) -> None:
    folder = self.folder
    (folder / 'wait.yaml').write_text(_MODE)
    done = _run(
      '--modes=walk_forward',
      f'--mode_file={folder / "wait.yaml"}',
      f'--out={folder / "out"}',
    )
    self.assertEqual(done.returncode, 0, done.stderr)
    book = mode_encoder.load(folder / 'out').codebook()
    self.assertEqual(book.names, ('walk_forward', 'wait'))
    for name in ('encoder.safetensors', 'encoder.json', 'encoding.png'):
      self.assertIn(f'wrote {folder / "out" / name}', done.stdout)
      self.assertTrue((folder / 'out' / name).stat().st_size)
    self.assertIn('worst RMSE', done.stderr)
    self.assertIn('RMSE of the base position', done.stdout)

  @parameterized.parameters(
    ({'modes': 'fly'}, 'fly'),
    ({'modes': 'idle,idle'}, 'unique'),
    ({'mode_file': '/nowhere.yaml'}, '/nowhere.yaml'),
    ({'seed': -1}, 'seed'),
    ({'out': '/proc/nowhere'}, '/proc/nowhere'),
    ({'out': __file__}, 'train_encoder_test.py'),
    ({'out': None}, '--out'),
  )
  def test_bad_input_fails_before_training(
    self, values: dict[str, Any], message: str
  ) -> None:
    out = self.folder / 'out'
    with (
      flagsaver.flagsaver(**{'out': str(out), **values}),
      mock.patch.object(encoder_training, 'train', side_effect=AssertionError),
      self.assertRaisesRegex((ValueError, OSError), message),
    ):
      flags.FLAGS.mark_as_parsed()
      train_encoder.main(['train_encoder'])
    self.assertFalse(out.exists())

  def test_bad_input_is_one_line(self) -> None:
    done = _run(f'--out={self.folder}', '--modes=fly')
    self.assertEqual(done.returncode, 2, done.stderr)
    self.assertLen(done.stderr.splitlines(), 1)

  def test_tables_and_figure(self) -> None:
    config = mode_encoder.EncoderConfig(max_rmse=0.5, min_separation=0.1)
    trained = encoder_training.train(library.resolve('pi2'), config)
    text = train_encoder.tables(trained)
    for name, error in trained.rmse().items():
      self.assertRegex(text, rf'{name} +{100 * error:.2f}')
      self.assertRegex(text, rf'\d {name}( +\d\.\d\d){{4}}')
    figure = train_encoder.draw(trained)
    self.assertLen(figure.axes, 3 * 4)


if __name__ == '__main__':
  absltest.main()
