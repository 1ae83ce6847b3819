"""What every room may use: files, configurations, schedules, shipped data."""

__all__ = ['config', 'files', 'lazy', 'resources', 'schedule']
