"""Tracks of box segments: level ground, obstacles, and courses of them."""

__all__ = ['layouts', 'pieces', 'terrain', 'track']
