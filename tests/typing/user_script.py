"""A user's script, for type checkers to read: every type must be known."""

from typing import assert_type

import dmc_multimode as dmm

assert_type(dmm.__version__, str)
