"""Locomotion modes: reference motions, schedules, latent encodings."""
