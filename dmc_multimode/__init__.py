"""Multimodal bipedal locomotion for dm_control."""

__version__ = '0.1.0'
