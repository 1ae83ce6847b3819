"""Tests of dmc_multimode.suite.curriculum."""

from absl.testing import absltest
from absl.testing import parameterized
import numpy as np

from dmc_multimode.suite.imitation import assistance as curriculum

_HELPED = np.array([False, True, False, True])


def _feed(
  assistance: curriculum.TakeoffAssistance,
  mode: int,
  survived: bool,
  count: int,
) -> None:
  assistance.update(np.full(count, mode), np.full(count, survived))


class TakeoffAssistanceTest(parameterized.TestCase):
  def test_fades_while_enough_survive(self) -> None:
    assistance = curriculum.TakeoffAssistance(1000, _HELPED)
    assistance.advance(500)
    self.assertEqual(assistance.share, 1.0)  # Nobody has survived anything.
    _feed(assistance, 1, True, 40)  # 1 - 0.995^40 = 0.18.
    assistance.advance(500)
    self.assertEqual(assistance.share, 1.0)
    _feed(assistance, 3, True, 60)  # 0.39.
    assistance.advance(500)
    self.assertEqual(assistance.share, 0.5)
    _feed(assistance, 1, False, 60)  # 0.29.
    assistance.advance(500)
    self.assertEqual(assistance.share, 0.5)
    _feed(assistance, 1, True, 200)
    assistance.advance(100)
    self.assertAlmostEqual(assistance.share, 0.4)
    assistance.advance(10_000)
    self.assertEqual(assistance.share, 0.0)

  def test_other_modes_do_not_count(self) -> None:
    assistance = curriculum.TakeoffAssistance(1000, _HELPED)
    _feed(assistance, 0, True, 1000)
    assistance.advance(1000)
    self.assertEqual(assistance.share, 1.0)

  @parameterized.parameters((0, _HELPED), (1000, np.zeros(4, bool)))
  def test_nobody_to_help(self, steps: int, helped: np.ndarray) -> None:
    self.assertEqual(curriculum.TakeoffAssistance(steps, helped).share, 0.0)

  def test_goes_on_where_it_was(self) -> None:
    assistance = curriculum.TakeoffAssistance(1000, _HELPED)
    _feed(assistance, 1, True, 200)
    assistance.advance(300)
    other = curriculum.TakeoffAssistance(1000, _HELPED)
    other.restore(assistance.state())
    for each in (assistance, other):
      each.advance(300)
      self.assertAlmostEqual(each.share, 0.4)

  @parameterized.parameters(
    (1.0, (0.0, 0.5, 0.0), (3.0, 0.0, 4.0)),  # Across: all is missing.
    (1.0, (0.6, 0.0, 0.8), (2.4, 0.0, 3.2)),
    (1.0, (4.0, 0.0, 4.0), (0.0, 0.0, 0.0)),  # Beyond it already.
    (0.5, (0.6, 0.0, 0.8), (1.5, 0.0, 2.0)),
    (0.5, (2.4, 0.0, 3.2), (0.6, 0.0, 0.8)),
    (0.5, (-3.0, 0.0, -4.0), (1.5, 0.0, 2.0)),
  )
  def test_boost(
    self,
    share: float,
    velocity: tuple[float, ...],
    expected: tuple[float, ...],
  ) -> None:
    assistance = curriculum.TakeoffAssistance(1000, _HELPED)
    assistance.share = share
    found = assistance.boost(np.array([velocity]), np.array([[3.0, 0.0, 4.0]]))
    np.testing.assert_allclose(found, [expected], atol=1e-12)


if __name__ == '__main__':
  absltest.main()
