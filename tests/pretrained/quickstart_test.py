"""The shipped quickstart policy still does what its metrics say."""

import dataclasses

from absl.testing import absltest
import numpy as np

from dmc_multimode import pretrained
from dmc_multimode.agents import evaluation
from dmc_multimode.agents.ppo import acting
from dmc_multimode.modes import schedule
from dmc_multimode.suite import batched
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import episodes
from dmc_multimode.suite import multimode_biped

_EPISODES = 4  # Of each mode.
_MARGIN = 0.05  # Of the mean return, for so few episodes.


class QuickstartTest(absltest.TestCase):
  def setUp(self) -> None:
    super().setUp()
    self.policy = pretrained.load('quickstart')
    self.config = config_lib.for_evaluation(self.policy.config)

  def test_modes_are_as_good_as_reported(self) -> None:
    count = len(self.policy.motions)
    modes = np.repeat(np.arange(count), _EPISODES)
    task = multimode_biped.make_task(
      self.policy.motions,
      self.policy.codebook,
      episodes.ScheduledEpisodes(schedule.single(modes)),
      config=self.config,
    )
    worlds = batched.BatchedImitation(task, len(modes), 1, auto_reset=False)
    found = evaluation.run_episodes(worlds, self.policy.select_action)
    self.assertTrue(found.survived.all())
    for i, motion in enumerate(self.policy.motions):
      reported = self.policy.metrics['modes'][motion.name]['mra']
      self.assertGreater(
        found.returns[modes == i].mean(), reported - _MARGIN, motion.name
      )

  def test_it_walks_in_composer_too(self) -> None:
    names = [motion.name for motion in self.policy.motions]
    walk = np.array([names.index('walk_forward')])
    task = multimode_biped.make_task(
      self.policy.motions,
      self.policy.codebook,
      episodes.ScheduledEpisodes(schedule.single(walk)),
      config=dataclasses.replace(self.config, time_limit=3.0),
    )
    environment = multimode_biped.make_environment(task, random=0)
    loop = acting.EnvironmentLoop(environment, self.policy.actor)
    self.assertTrue(loop.run_episode()['survived'])
    walked = environment.physics.data.qpos[0]
    self.assertBetween(walked, 0.5 * 2.5, 0.7 * 3.0)


if __name__ == '__main__':
  absltest.main()
