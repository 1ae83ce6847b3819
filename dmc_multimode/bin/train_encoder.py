r"""Trains the mode encoder of a mode set and draws its encoding.

  python -m dmc_multimode.bin.train_encoder --modes=pi2 --out=DIR

Writes encoder.safetensors, encoder.json and encoding.png into DIR.
"""

from typing import Sequence, TYPE_CHECKING

from absl import flags
import numpy as np

from dmc_multimode.bin import app
from dmc_multimode.bin import flags as config_flags
from dmc_multimode.modes import files as mode_files
from dmc_multimode.modes import library
from dmc_multimode.modes import motion as motion_lib
from dmc_multimode.utils import files
from dmc_multimode.utils import progress_bar

if TYPE_CHECKING:
  import matplotlib.figure

  from dmc_multimode.modes.encoder import mode_encoder
  from dmc_multimode.modes.encoder import training as encoder_training

_FIGURE_FILE = 'encoding.png'
_AXES = 'xyz'

_MODES = flags.DEFINE_string(
  'modes', 'pi2', 'A mode set (pi1, pi2, ...) or mode names with commas.'
)
_MODE_FILE = config_flags.define_path(
  'mode_file', None, 'YAML or JSON file of your own modes, added to --modes.'
)
_OUT = config_flags.define_path('out', None, 'Directory to write to.')
_SEED = flags.DEFINE_integer('seed', 0, 'Seed of the initial weights.')


def main(argv: Sequence[str]) -> None:
  """Checks the input, trains, then writes; `argv` holds no flags."""
  del argv
  motions = _motions(_MODES.value, _MODE_FILE.value)
  motion_lib.check_names(motions)  # Refuses duplicates before the progress bar.
  out = files.output_folder('out', _OUT.value)
  if out is None:
    raise ValueError('Say where to write to: --out=DIR.')
  # Late, as these import torch and matplotlib.
  from dmc_multimode.evaluation import figures
  from dmc_multimode.modes.encoder import mode_encoder

  trained = _train(motions, _SEED.value)
  print(tables(trained))
  figure = draw(trained)
  trained.save(out)
  figures.save(out / _FIGURE_FILE, figure)
  for name in (
    mode_encoder.WEIGHTS_FILE,
    mode_encoder.CONFIG_FILE,
    _FIGURE_FILE,
  ):
    print(f'wrote {out / name}')


def tables(trained: 'mode_encoder.ModeEncoder') -> str:
  """Returns the RMSE per mode and the distances between latents as text."""
  names = list(trained.rmse())
  width = max(len(name) for name in names)
  lines = ['Reconstruction RMSE of the base position (cm)']
  lines += [
    f'  {name:<{width}}  {100 * error:5.2f}'
    for name, error in trained.rmse().items()
  ]
  lines += ['', 'Distances between the standardised latents']
  heading = ''.join(f'{i:>6}' for i in range(len(names)))
  lines.append(f'  {"":>{width + 3}}{heading}')
  for i, row in enumerate(trained.distances()):
    cells = ''.join(f'{distance:6.2f}' for distance in row)
    lines.append(f'  {i:>2} {names[i]:<{width}}{cells}')
  ratio = trained.codebook().separation()
  lines += ['', f'Smallest over mean distance: {ratio:.2f}']
  return '\n'.join(lines)


def draw(trained: 'mode_encoder.ModeEncoder') -> 'matplotlib.figure.Figure':
  """Draws the paper's encoding figure, a column a mode.

  Base positions over time of the references on top, of the reconstructions in
  the centre, and the latents as bars at the bottom.
  """
  from dmc_multimode.evaluation import figures
  from dmc_multimode.modes.encoder import network

  motions, book = trained.motions, trained.codebook()
  figure, axes = figures.empty(3, len(motions), 2.5, 2.0)
  for other in axes[:2].flat[1:]:  # One scale in metres for both rows.
    other.sharey(axes[0, 0])
  for other in axes[2, 1:]:
    other.sharey(axes[2, 0])
  reconstructed = trained.reconstruct(motions)
  for column, motion in enumerate(motions):
    wanted = network.features(motion, *trained.config.contacts)
    times = np.linspace(0.0, motion.duration, len(wanted))
    for row, path in enumerate((wanted, reconstructed[column])):
      for axis, colour in zip(range(3), ('C0', 'C1', 'C2'), strict=True):
        axes[row, column].plot(
          times, path[:, axis], color=colour, label=_AXES[axis]
        )
      axes[row, column].set_xlabel('time (s)')
    bars = axes[2, column]
    bars.bar(np.arange(1, book.latent_dim + 1), book.latents[column])
    bars.axhline(0.0, color='black', linewidth=0.5)
    bars.set_xlabel('latent dimension')
    axes[0, column].set_title(motion.name)
  for row, label in enumerate(
    ('reference (m)', 'reconstruction (m)', 'latent')
  ):
    axes[row, 0].set_ylabel(label)
  axes[0, 0].legend(fontsize='small')
  return figure


def _motions(
  spec: str, mode_file: str | None
) -> tuple[motion_lib.ReferenceMotion, ...]:
  """Returns the modes of `spec`, followed by those of a mode file."""
  extra = mode_files.load(mode_file) if mode_file else ()
  motions = library.resolve(spec, extra)
  named = {motion.name for motion in motions}
  return motions + tuple(m for m in extra if m.name not in named)


def _train(
  motions: Sequence[motion_lib.ReferenceMotion], seed: int
) -> 'mode_encoder.ModeEncoder':
  """Trains under a progress bar."""
  from dmc_multimode.modes.encoder import training as encoder_training

  with progress_bar.Bar(desc='encoder', unit='epoch') as bar:

    def show(progress: 'encoder_training.Progress') -> None:
      bar.update()
      bar.set_postfix_str(
        f'worst RMSE {100 * progress.worst_rmse:.1f} cm, '
        f'separation {progress.separation:.2f}',
        refresh=False,
      )

    return encoder_training.train_for(motions, seed, show)


def cli() -> None:
  """Runs as a console script."""
  app.run(main)


if __name__ == '__main__':
  cli()
