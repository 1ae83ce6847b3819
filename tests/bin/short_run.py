"""A training that is over in a moment, for tests of the binary."""

ITERATION = 8 * 4  # Control steps.
STEPS = 12 * ITERATION  # Two rows of the logs, and some that no row tells of.
FLAGS = (
  '--num_worlds=8',
  '--ppo_rollout_length=4',
  '--ppo_hidden_sizes=16',
  '--modes=idle,walk_forward',
  '--one_hot',
)
# What is imported late, and what the first model costs.
WARM_UP = """
import torch
from torch.utils import tensorboard
from dmc_multimode.experiments import training
torch.optim.Adam([torch.zeros(1)])
from dmc_multimode.modes import library
from dmc_multimode.suite import multimode_biped
from dmc_multimode.suite.imitation import mujoco_worlds
mujoco_worlds.compile_model(multimode_biped.make_task(library.mode_set('idle')))
"""
