"""The robots: MJCF models as dm_control walkers, and their kinematics."""

__all__ = ['kinematics', 'mini_biped']
