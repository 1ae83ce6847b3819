"""Tracks of box segments: level ground, gaps, plateaus, blocks, parkour."""

__all__ = ['layouts', 'terrain', 'track']
