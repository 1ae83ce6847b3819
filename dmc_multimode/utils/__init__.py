"""Utilities of all rooms: files, configurations, schedules, shipped data."""

__all__ = ['config', 'files', 'lazy', 'resources', 'schedule']
