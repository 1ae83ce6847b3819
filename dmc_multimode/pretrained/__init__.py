"""Trained policies that ship with the package, and loading any policy.

from dmc_multimode import pretrained
pretrained.names()
policy = pretrained.load('quickstart')
"""

from dmc_multimode.pretrained.policy import load
from dmc_multimode.pretrained.policy import names
from dmc_multimode.pretrained.policy import Policy

__all__ = ['Policy', 'load', 'names']
