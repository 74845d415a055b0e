"""The six locomotion tasks as rows of one table. Weights, ranges and noise are those of gymnasium's `-v5`."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from envs.physics import Data


@struct.dataclass(kw_only=True)
class CostInputs:
    """What the quantity behind a task's cost may depend on."""

    velocity: jax.Array  # [2] m/s, of the root during the control step
    control_cost: jax.Array  # [] the task's weight times the sum of squared actions
    contact_cost: jax.Array  # [] 0 where the contact term is switched off
    # The `Data` after the control step and the action [action_dim] as executed. Both are None where an episode of
    # gymnasium's simulator is scored, which reports the three numbers above alone.
    data: Any = None
    action: Any = None


OfData = Callable[[mujoco.MjModel, Data], jax.Array]
Rewards = Callable[[mujoco.MjModel, Data, jax.Array], dict[str, jax.Array]]
Start = Callable[[mujoco.MjModel, jax.Array], tuple[jax.Array, jax.Array]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocomotionTask:
    """One row of the table: the model, and what observation, reward, cost, termination and start are made of.

    The usual observation is `qpos` without its first `num_hidden` entries, then `qvel`, then the arrays in `extra_obs`.
    The usual reward is the sum of those of these terms that `reward_terms` names, with v the root's velocity along x
    in m/s, a the action as executed and f the contact forces:

        forward = forward_weight v      healthy = healthy_reward (0 where the robot is not healthy)
        control = -control_weight |a|^2      contact = -contact(f)

    A row may have an observation, a reward and a start of its own instead. Their functions are pure JAX, for a single
    simulation; of `MjData` they may read what `fields` names, in `Data.fields`.
    """

    xml: str  # the model: a file among gymnasium's own assets, or an absolute path
    frame_skip: int  # engine steps per control step
    num_hidden: int = 0  # leading root coordinates left out of the observation
    velocity_clip: float | None = None  # of qvel in the observation
    extra_obs: tuple[tuple[str, int], ...] = ()  # derived arrays appended, each from this row on
    track: str | None = None  # the `MjData` array whose change gives the velocity; None: the velocity is 0
    displacement: OfData | None = None  # [2] m, of the root over a control step, from `Data.change`
    forward_weight: float = 1.0
    control_weight: float = 0.0
    healthy_reward: float = 0.0
    healthy: OfData | None = None  # [] bool; None: always healthy. An episode terminates where it is false
    reward_terms: tuple[str, ...] = ("forward", "healthy")  # the paper authors' reward is the sum of these
    contact: Callable[[jax.Array], jax.Array] | None = None  # [] contact cost, of cfrc_ext [nbody, 6]
    cost_quantity: Callable[[CostInputs], jax.Array]  # []; the cost is 1 where it exceeds the threshold
    qpos_noise: float = 0.0  # an episode starts at the model's qpos0 plus uniform noise of this half-width
    qvel_noise: float = 0.0  # and with a velocity that is uniform noise of this half-width
    qvel_normal: bool = False  # or, if this is set, normal noise of this standard deviation
    fields: tuple[str, ...] = ()  # derived `MjData` arrays that this row's own functions read
    observe: OfData | None = None  # [obs_dim], in place of the usual observation
    reward: Rewards | None = None  # of (model, data, action): named terms, [] each, whose sum is the reward
    start: Start | None = None  # of (model, key): qpos [nq] and qvel [nv] that an episode starts with
    view: Literal["side", "above"] = "side"  # from where films show the robot: along the y axis, or down the z axis


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


def _hopper_healthy(model: mujoco.MjModel, data: Data) -> jax.Array:
    del model
    qpos, qvel = data.qpos, data.qvel
    inside = _between(jnp.concatenate([qpos[2:], qvel]), -100.0, 100.0).all()
    return inside & (qpos[1] > 0.7) & _between(qpos[2], -0.2, 0.2)


def _walker_healthy(model: mujoco.MjModel, data: Data) -> jax.Array:
    del model
    return _between(data.qpos[1], 0.8, 2.0) & _between(data.qpos[2], -1.0, 1.0)


def _ant_healthy(model: mujoco.MjModel, data: Data) -> jax.Array:
    del model
    finite = jnp.isfinite(data.qpos).all() & jnp.isfinite(data.qvel).all()
    return finite & (data.qpos[2] >= 0.2) & (data.qpos[2] <= 1.0)


def _humanoid_healthy(model: mujoco.MjModel, data: Data) -> jax.Array:
    del model
    return _between(data.qpos[2], 1.0, 2.0)


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
        view="above",
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
