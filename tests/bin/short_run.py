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
