"""Makes the links of README.md absolute, for the package index.

There are no files beside the text there. Everything else is in setup.cfg.
"""

import pathlib
import re

import setuptools

_URL = 'https://github.com/dmc-multimode/dmc_multimode'
_RELATIVE = re.compile(r'(!?)\[([^\]]*)\]\((?!https?:|#)([^)]*)\)')


def _absolute(link: re.Match[str]) -> str:
  """Returns a link to a page, or to the content of an image."""
  kind = 'raw' if link[1] else 'blob'
  return f'{link[1]}[{link[2]}]({_URL}/{kind}/main/{link[3]})'


_README = pathlib.Path(__file__).with_name('README.md').read_text('utf-8')
setuptools.setup(long_description=_RELATIVE.sub(_absolute, _README))
