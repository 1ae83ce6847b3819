"""Tracks of box segments: level ground, obstacles, and courses of them."""

from dmc_multimode.utils import gl

# Before modules of it import dm_control, which looks for a display.
gl.choose_late_without_display()

__all__ = ['layouts', 'pieces', 'terrain', 'track']
