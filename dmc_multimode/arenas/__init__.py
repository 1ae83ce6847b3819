"""Tracks of box segments: level ground, gaps, plateaus, blocks, parkour."""
