"""The commands of the package; see `app`."""

import warnings

# dm_control tries to open a display when it is imported, and warns. Commands
# that render choose a backend first (`gl`); the others render nothing.
warnings.filterwarnings('ignore', message='.*DISPLAY environment variable')

__all__ = ['app', 'flags']
