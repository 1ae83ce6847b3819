"""Variants of the physics of `BatchedImitation`, each one change apart.

A variant edits the MJCF of an `Imitation` task before it is compiled, or the
compiled model, or the physics step.
"""

import ctypes
import dataclasses
import functools
import pathlib
from typing import Any, Callable, Mapping

import mujoco

from dmc_multimode.suite import batched
from dmc_multimode.suite import config as config_lib
from dmc_multimode.suite import imitation
from dmc_multimode.suite import mini_biped

Edit = Callable[[imitation.Imitation], None]
Remodel = Callable[[imitation.Imitation, mujoco.MjModel], mujoco.MjModel]

DEFAULT = 'default'
# Of the sole, metres: half-length, half-width and half-height of the box.
_LENGTH, _WIDTH, _HEIGHT = 0.075, 0.02, 0.01
_LIMBS = tuple(
  f'{side}_{part}' for side in mini_biped.SIDES for part in ('thigh', 'calf')
)


@dataclasses.dataclass(frozen=True)
class Variant:
  """One way to compute the physics.

  Attributes:
    edits: of the task, before its model is compiled.
    remodel: gets the task and the model that `BatchedImitation` compiled;
      returns the model to use.
    timestep: of the physics, seconds; None for the configuration's.
    profiler: whether the engine's timers run, as they do from the import of
      mujoco on.
  """

  edits: tuple[Edit, ...] = ()
  remodel: Remodel = lambda task, model: model
  timestep: float | None = None
  profiler: bool = True

  def configure(
    self, config: config_lib.ImitationConfig
  ) -> config_lib.ImitationConfig:
    """Returns `config` with the variant's physics step."""
    timestep = self.timestep or config.physics_timestep
    return dataclasses.replace(config, physics_timestep=timestep)


@functools.cache
def _timer() -> ctypes.c_void_p:
  """The engine's clock, a C callback; where it is NULL, no time is taken."""
  library = next(pathlib.Path(mujoco.__file__).parent.glob('libmujoco*'))
  return ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), 'mjcb_time')


@functools.cache
def _clock() -> int | None:
  """The clock that the import of mujoco installed."""
  return _timer().value


def set_profiler(on: bool) -> None:
  """Switches the engine's timers of this process on or off."""
  clock = _clock()
  _timer().value = clock if on else None


def _option(flag: bool = False, **values: Any) -> Variant:
  """Returns a variant with other attributes of <option>, or of its <flag>."""

  def edit(task: imitation.Imitation) -> None:
    option = task.root_entity.mjcf_model.option
    (option.flag if flag else option).set_attributes(**values)

  return Variant((edit,))


def _iterations(most: int, line_search: int) -> Variant:
  return _option(iterations=most, ls_iterations=line_search)


def _root(task: imitation.Imitation) -> Any:
  return task.walker.mjcf_model


def _feet(*parts: Mapping[str, Any]) -> Variant:
  """Returns a variant whose soles are these geoms.

  Args:
    *parts: attributes of a geom each, relative to the middle of the sole.
  """

  def edit(task: imitation.Imitation) -> None:
    for side in mini_biped.SIDES:
      sole = _root(task).find('geom', f'{side}_foot')
      x, y, z = sole.pos
      names = [sole.name, *(f'{sole.name}_{i}' for i in range(1, len(parts)))]
      sole_body = sole.parent
      sole.remove()
      for name, part in zip(names, parts, strict=True):
        place = 'pos' if 'pos' in part else 'fromto'
        moved = [
          a + b for a, b in zip(part[place], 2 * (x, y, z), strict=False)
        ]
        sole_body.add(
          'geom', name=name, dclass='foot', **{**part, place: moved}
        )

  return Variant((edit,))


def _capsule(*fromto: float) -> dict[str, Any]:
  return {'type': 'capsule', 'size': [_HEIGHT], 'fromto': fromto}


def _sphere(x: float, y: float) -> dict[str, Any]:
  return {'type': 'sphere', 'size': [_HEIGHT], 'pos': (x, y, 0.0)}


def _lengthwise(y: float) -> dict[str, Any]:
  return _capsule(_HEIGHT - _LENGTH, y, 0.0, _LENGTH - _HEIGHT, y, 0.0)


def _crosswise(x: float) -> dict[str, Any]:
  return _capsule(x, _HEIGHT - _WIDTH, 0.0, x, _WIDTH - _HEIGHT, 0.0)


def _drop_limbs(task: imitation.Imitation) -> None:
  """Lets thighs and calves pass through everything."""
  for name in _LIMBS:
    _root(task).find('geom', name).remove()


def _box_limbs(task: imitation.Imitation) -> None:
  """Makes boxes of the capsules of thighs and calves, as long and as thick.

  A box above the ground is told apart from it by the first axis that is tried;
  for a capsule the whole distance to the ground's box is computed.
  """
  for name in _LIMBS:
    limb = _root(task).find('geom', name)
    (radius,), (x, y, top, _, _, bottom) = limb.size, limb.fromto
    half = abs(top - bottom) / 2 + radius
    del limb.fromto
    limb.set_attributes(
      type='box', size=[radius, radius, half], pos=[x, y, (top + bottom) / 2]
    )


def _add_pairs(task: imitation.Imitation) -> None:
  """Names each pair of geoms that may touch: robot and ground."""
  for ground in task.root_entity.ground_geoms:
    for geom in _root(task).find_all('geom'):
      if (geom.dclass and geom.dclass.dclass) in ('collision', 'foot'):
        task.root_entity.mjcf_model.contact.add(
          'pair', geom1=ground, geom2=geom, condim=3, friction=_PAIR_FRICTION
        )


# What MuJoCo mixes from those of the ground and of the robot.
_PAIR_FRICTION = (0.9, 0.9, 0.005, 0.0001, 0.0001)


def _only_pairs(
  task: imitation.Imitation, model: mujoco.MjModel
) -> mujoco.MjModel:
  """Leaves no body that might touch others, so that nobody looks for any."""
  del task
  model.body_contype[:] = model.body_conaffinity[:] = 0
  return model


def _with_visuals(
  task: imitation.Imitation, model: mujoco.MjModel
) -> mujoco.MjModel:
  """Returns the model with visual geoms, sites, cameras and lights."""
  del model
  return batched.make_spec(task).compile()


def _drop_friction(task: imitation.Imitation) -> None:
  for name in ('hip_yaw', 'hip_roll'):
    _root(task).default.find('default', name).joint.frictionloss = 0.0


def _damp_joints(task: imitation.Imitation) -> None:
  """Moves the servos' damping to the joints, where Euler is implicit in it.

  Unlike Eq. 2, the torque limit then does not apply to the damping.
  """
  servo = _root(task).default.find('default', 'servo').position
  for joint in task.walker.observable_joints:
    damping = joint.dclass.joint.damping if joint.dclass else None
    joint.damping = servo.kv + (damping or 0.0)
  servo.kv = 0.0


def _armature(inertia: float) -> Variant:
  """Returns a variant with that inertia of every rotor, kg m^2."""

  def edit(task: imitation.Imitation) -> None:
    for joint in task.walker.observable_joints:
      joint.armature = inertia

  return Variant((edit,))


def _add_servo_inertia(task: imitation.Imitation) -> None:
  task.walker.add_servo_inertia(task.config.physics_timestep)


def combine(*variants: Variant) -> Variant:
  """Returns a variant with the changes of all; the last says the step."""
  edits: tuple[Edit, ...] = ()
  for variant in variants:
    edits += variant.edits

  def remodel(
    task: imitation.Imitation, model: mujoco.MjModel
  ) -> mujoco.MjModel:
    for variant in variants:
      model = variant.remodel(task, model)
    return model

  steps = [variant.timestep for variant in variants if variant.timestep]
  return Variant(
    edits,
    remodel,
    steps[-1] if steps else None,
    all(variant.profiler for variant in variants),
  )


_NO_PROFILER = Variant(profiler=False)
_BOX_LIMBS = Variant((_box_limbs,))
_PAIRS = Variant((_add_pairs,), _only_pairs)
_INERTIA = Variant((_add_servo_inertia,))
_EULER = _option(integrator='Euler')
_EXACT = combine(_PAIRS, _NO_PROFILER)  # Not one bit of the states changes.
_COMBINED = combine(_EXACT, _BOX_LIMBS, _INERTIA, Variant(timestep=0.0075))

VARIANTS: Mapping[str, Variant] = {
  DEFAULT: Variant(),
  '10ms': Variant(timestep=0.01),
  '7.5ms': Variant(timestep=0.0075),
  '6ms': Variant(timestep=0.006),
  '3ms': Variant(timestep=0.003),
  '2ms': Variant(timestep=0.002),
  '1ms': Variant(timestep=0.001),
  'inertia': _INERTIA,
  'inertia_6ms': combine(_INERTIA, Variant(timestep=0.006)),
  'inertia_7.5ms': combine(_INERTIA, Variant(timestep=0.0075)),
  'inertia_10ms': combine(_INERTIA, Variant(timestep=0.01)),
  'inertia_15ms': combine(_INERTIA, Variant(timestep=0.015)),
  'cg': _option(solver='CG'),
  'pgs': _option(solver='PGS'),
  'iterations_10': _iterations(10, 10),
  'iterations_4': _iterations(4, 6),
  'iterations_3': _iterations(3, 4),
  'tolerance_1e-6': _option(tolerance=1e-6),
  'tolerance_1e-4': _option(tolerance=1e-4),
  'tolerance_1e-3': _option(tolerance=1e-3),
  'ls_tolerance_0.1': _option(ls_tolerance=0.1),
  'sparse': _option(jacobian='sparse'),
  'elliptic': _option(cone='elliptic'),
  'euler': _EULER,
  'euler_joint_damping': combine(_EULER, Variant((_damp_joints,))),
  'implicit': _option(integrator='implicit'),
  'islands': _option(flag=True, island='enable'),
  'no_warmstart': _option(flag=True, warmstart='disable'),
  'no_midphase': _option(flag=True, midphase='disable'),
  'multiccd': _option(flag=True, multiccd='enable'),
  'no_nativeccd': _option(flag=True, nativeccd='disable'),
  'feet_capsule': _feet(_lengthwise(0.0)),
  'feet_2_capsules': _feet(
    _lengthwise(_WIDTH - _HEIGHT), _lengthwise(_HEIGHT - _WIDTH)
  ),
  'feet_4_spheres': _feet(
    *(
      _sphere(x * (_LENGTH - _HEIGHT), y * (_WIDTH - _HEIGHT))
      for x in (1, -1)
      for y in (1, -1)
    )
  ),
  'feet_crosswise': _feet(
    _crosswise(_LENGTH - _HEIGHT), _crosswise(_HEIGHT - _LENGTH)
  ),
  'feet_tripod': _feet(
    _crosswise(_LENGTH - _HEIGHT), _sphere(_HEIGHT - _LENGTH, 0.0)
  ),
  'no_limbs': Variant((_drop_limbs,)),
  'box_limbs': _BOX_LIMBS,
  'pairs': _PAIRS,
  'visuals': Variant(remodel=_with_visuals),
  'no_frictionloss': Variant((_drop_friction,)),
  'armature_0.01': _armature(0.01),
  'no_profiler': _NO_PROFILER,
  'exact': _EXACT,
  'exact_box_limbs': combine(_EXACT, _BOX_LIMBS),
  'combined': _COMBINED,
  'combined_10ms': combine(_COMBINED, Variant(timestep=0.01)),
}
