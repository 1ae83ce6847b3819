"""Tests of dmc_multimode.utils.progress_bar."""

import io
import sys

import pytest

from dmc_multimode.utils import progress_bar


class _Terminal(io.StringIO):
  """Text that calls itself a terminal."""

  def isatty(self) -> bool:
    return True


def _run(monkeypatch: pytest.MonkeyPatch, file: io.StringIO) -> str:
  """Returns what three steps write, one of 20 s each, and a message."""
  now = [100.0]
  monkeypatch.setattr(sys, 'stderr', file)
  monkeypatch.setattr(progress_bar.time, 'monotonic', lambda: now[0])
  with progress_bar.Bar(total=3, desc='films', mininterval=0) as bar:
    for _ in range(3):
      now[0] += 20.0
      bar.update()
    progress_bar.Bar.write('a message', sys.stderr)
  return file.getvalue()


def test_log_has_a_line_every_half_minute(
  monkeypatch: pytest.MonkeyPatch,
) -> None:
  text = _run(monkeypatch, io.StringIO())
  assert '\r' not in text and text.endswith('\n')
  starts = ['films:  67% 2/3', 'a message', 'films: 100% 3/3']
  lines = text.splitlines()
  assert len(lines) == len(starts)
  for line, start in zip(lines, starts, strict=True):
    assert line.startswith(start)


def test_total_is_known_beyond_it(monkeypatch: pytest.MonkeyPatch) -> None:
  """A training ends with whole iterations."""
  file = io.StringIO()
  monkeypatch.setattr(sys, 'stderr', file)
  with progress_bar.Bar(total=36) as bar:
    bar.update(40)
  assert file.getvalue().startswith('100% 40/40')


def test_terminal_has_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
  text = _run(monkeypatch, _Terminal())
  bars = text.split('\r')
  assert sum('films' in bar for bar in bars) > 3 and '%|###3 ' in text
  assert text.count('\n') == 2  # Of the message and at the end.
