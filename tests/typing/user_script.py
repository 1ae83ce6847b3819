"""A user's script, for type checkers to read: every type must be known."""

import pathlib
from typing import Any, assert_type

import numpy as np

import dmc_multimode as dmm
from dmc_multimode.planner.plan import PlanResult
from dmc_multimode.suite.imitation.batched_env import BatchedImitation
from dmc_multimode.viewer.recording import Recording

assert_type(dmm.__version__, str)

env = dmm.load('walk_forward', random=0)
while not env.reset().last():
  env.step(np.zeros(10))

worlds = dmm.make_worlds('pi2', num_worlds=512, seed=0)
assert_type(worlds, BatchedImitation)
policy = dmm.load_policy('pi2')
assert_type(policy, dmm.Policy)
assert_type(policy.mode_set.names, tuple[str, ...])
assert_type(policy.config.control_timestep, float)
policy.save('copy')
policy.save(pathlib.Path('copy'))

step = worlds.step(policy.select_action(worlds.reset()))
returns = worlds.reset() * step.reward[:, None]

mine = dmm.train('runs/mine', modes='pi2', steps=10_000_000, ppo_discount=0.98)
assert_type(mine, dmm.Policy)
report = dmm.evaluate(policy, seed=0)
assert_type(report, dict[str, Any])
result = dmm.plan(policy, arena='gap', seed=0)
assert_type(result, PlanResult)
assert_type(result.success, bool)
result.save('plan.json')
video = dmm.record(policy, schedule='walk_forward:2,launch:2', out='video.mp4')
assert_type(video, Recording)
dmm.record('pi2', plan=pathlib.Path('plan.json'), out=pathlib.Path('plan.gif'))
