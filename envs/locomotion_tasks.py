"""The six locomotion tasks as rows of one table. Weights, ranges and noise are those of gymnasium's `-v5`."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from envs.physics import Data

Velocity = Callable[[mujoco.MjModel, Data], jax.Array]
Healthy = Callable[[jax.Array, jax.Array], jax.Array]


@struct.dataclass(kw_only=True)
class CostInputs:
    """What a cost may depend on."""

    velocity: jax.Array  # [2] of the root in m/s
    control_cost: jax.Array  # [] the task's weight times the sum of squared actions
    contact_cost: jax.Array  # [] zero where the contact term is switched off


Quantity = Callable[[CostInputs], jax.Array]


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocomotionTask:
    """One row of the table: the model, and what observation, reward, cost and termination are made of."""

    xml: str  # file among gymnasium's own assets
    frame_skip: int
    num_hidden: int  # leading root coordinates left out of the observation
    velocity_clip: float | None = None  # of qvel in the observation
    extra_obs: tuple[tuple[str, int], ...] = ()  # derived arrays appended, each from this row on
    track: str  # whose change gives the velocity
    displacement: Velocity  # of the root over a control step, [2] in m
    forward_weight: float = 1.0
    control_weight: float
    healthy_reward: float = 0.0
    healthy: Healthy | None = None  # of (qpos, qvel); None: always, and the task never terminates
    reward_terms: tuple[str, ...] = ("forward", "healthy")  # the authors' reward is the sum of these
    contact: Callable[[jax.Array], jax.Array] | None = None  # contact cost of cfrc_ext
    cost_quantity: Quantity  # the cost is 1 where it exceeds the threshold
    qpos_noise: float  # uniform on +-
    qvel_noise: float
    qvel_normal: bool = False  # normal with sd `qvel_noise` instead of uniform


def _first_coordinate(model: mujoco.MjModel, data: Data) -> jax.Array:
    del model
    change = data.change["qpos"]
    return change[:2] * jnp.array([1.0, 0.0], change.dtype)


def _first_two_coordinates(model: mujoco.MjModel, data: Data) -> jax.Array:
    del model
    return data.change["qpos"][:2]


def _torso(model: mujoco.MjModel, data: Data) -> jax.Array:
    del model
    return data.change["xpos"][1, :2]


def _centre_of_mass(model: mujoco.MjModel, data: Data) -> jax.Array:
    mass = model.body_mass / model.body_mass.sum()
    return jnp.asarray(mass, data.qpos.dtype) @ data.change["xipos"][:, :2]


def _between(x: jax.Array, low: float, high: float) -> jax.Array:
    return (low < x) & (x < high)


def _hopper_healthy(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    inside = _between(jnp.concatenate([qpos[2:], qvel]), -100.0, 100.0).all()
    return inside & (qpos[1] > 0.7) & _between(qpos[2], -0.2, 0.2)


def _walker_healthy(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    del qvel
    return _between(qpos[1], 0.8, 2.0) & _between(qpos[2], -1.0, 1.0)


def _ant_healthy(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    finite = jnp.isfinite(qpos).all() & jnp.isfinite(qvel).all()
    return finite & (qpos[2] >= 0.2) & (qpos[2] <= 1.0)


def _humanoid_healthy(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    del qvel
    return _between(qpos[2], 1.0, 2.0)


TABLE = {
    "Swimmer": LocomotionTask(
        xml="swimmer.xml",
        frame_skip=4,
        num_hidden=2,
        track="qpos",
        displacement=_first_two_coordinates,
        control_weight=1e-4,
        reward_terms=("forward", "control"),
        cost_quantity=lambda x: jnp.linalg.norm(x.velocity),
        qpos_noise=0.1,
        qvel_noise=0.1,
    ),
    "HalfCheetah": LocomotionTask(
        xml="half_cheetah.xml",
        frame_skip=5,
        num_hidden=1,
        track="qpos",
        displacement=_first_coordinate,
        control_weight=0.1,
        reward_terms=("forward",),
        cost_quantity=lambda x: x.control_cost,
        qpos_noise=0.1,
        qvel_noise=0.1,
        qvel_normal=True,
    ),
    "Hopper": LocomotionTask(
        xml="hopper.xml",
        frame_skip=4,
        num_hidden=1,
        velocity_clip=10.0,
        track="qpos",
        displacement=_first_coordinate,
        control_weight=1e-3,
        healthy_reward=1.0,
        healthy=_hopper_healthy,
        cost_quantity=lambda x: 1000.0 * x.control_cost,
        qpos_noise=5e-3,
        qvel_noise=5e-3,
    ),
    "Walker2d": LocomotionTask(
        xml="walker2d_v5.xml",
        frame_skip=4,
        num_hidden=1,
        velocity_clip=10.0,
        track="qpos",
        displacement=_first_coordinate,
        control_weight=1e-3,
        healthy_reward=1.0,
        healthy=_walker_healthy,
        reward_terms=("forward", "healthy", "control"),
        cost_quantity=lambda x: jnp.abs(x.velocity[0]),
        qpos_noise=5e-3,
        qvel_noise=5e-3,
    ),
    "Ant": LocomotionTask(
        xml="ant.xml",
        frame_skip=5,
        num_hidden=2,
        track="xpos",
        displacement=_torso,
        control_weight=0.5,
        healthy_reward=1.0,
        healthy=_ant_healthy,
        contact=lambda force: 5e-4 * jnp.square(jnp.clip(force, -1.0, 1.0)).sum(),
        cost_quantity=lambda x: x.control_cost + x.contact_cost,
        qpos_noise=0.1,
        qvel_noise=0.1,
        qvel_normal=True,
    ),
    "Humanoid": LocomotionTask(
        xml="humanoid.xml",
        frame_skip=5,
        num_hidden=2,
        extra_obs=(("cinert", 1), ("cvel", 1), ("qfrc_actuator", 6)),  # without the world's and the root's rows
        track="xipos",
        displacement=_centre_of_mass,
        forward_weight=1.25,
        control_weight=0.1,
        healthy_reward=5.0,
        healthy=_humanoid_healthy,
        contact=lambda force: jnp.minimum(5e-7 * jnp.square(force).sum(), 10.0),
        cost_quantity=lambda x: x.control_cost + x.contact_cost,
        qpos_noise=1e-2,
        qvel_noise=1e-2,
    ),
}
