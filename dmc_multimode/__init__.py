"""Multimodal bipedal locomotion for dm_control."""
