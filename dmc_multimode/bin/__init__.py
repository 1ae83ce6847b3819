"""The commands of the package; see `app`."""

import warnings

# dm_control tries a display when it is imported. Commands that draw choose
# another way first (`gl`), the others draw nothing: no need to tell the user.
warnings.filterwarnings('ignore', message='.*DISPLAY environment variable')

__all__ = ['app', 'flags']
