"""Mode encoder: one latent z for a whole reference motion (Sec. II-B)."""

from dmc_multimode.modes.encoder.extension import extend
from dmc_multimode.modes.encoder.mode_encoder import EncoderConfig
from dmc_multimode.modes.encoder.mode_encoder import load
from dmc_multimode.modes.encoder.mode_encoder import ModeEncoder
from dmc_multimode.modes.encoder.training import ConvergenceError
from dmc_multimode.modes.encoder.training import needs_contacts
from dmc_multimode.modes.encoder.training import train
from dmc_multimode.modes.encoder.training import train_for

__all__ = (
  'ConvergenceError',
  'EncoderConfig',
  'ModeEncoder',
  'extend',
  'load',
  'needs_contacts',
  'train',
  'train_for',
)
