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
    """What the quantity behind a task's cost may depend on.

    `data` and `action` are None where an episode of gymnasium's simulator is scored, which reports the other three.

    Attributes:
        velocity: [2] m/s, of the root during the control step.
        control_cost: [], the task's weight times the sum of squared actions.
        contact_cost: [], 0 where the contact term is switched off.
        data: the `envs.physics.Data` after the control step.
        action: [action_dim], as executed.
    """

    velocity: jax.Array
    control_cost: jax.Array
    contact_cost: jax.Array
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

    A row may have an observation, a reward and a start of its own instead. The functions are pure JAX, for a single
    simulation. `model` is the `mujoco.MjModel`; `data` is the `envs.physics.Data` after the control step, and of other
    arrays of `MjData` has those that `fields` names, in `data.fields`.

    Attributes:
        xml: the model: a file among gymnasium's own assets, or an absolute path.
        frame_skip: engine steps per control step.
        num_hidden: leading coordinates of the root that are left out of the observation.
        velocity_clip: largest absolute value of qvel in the observation; None: any.
        extra_obs: derived arrays appended to the observation, each by its name and from this row on.
        track: the `MjData` array whose change over the control step is in `data.change`; None: none.
        displacement: of (model, data): [2] m, by how much the root has moved in the control step, usually from
            `data.change`. Divided by the step's duration it is the root's velocity; None: the velocity is 0.
        forward_weight: of the term "forward".
        control_weight: of the term "control".
        healthy_reward: the term "healthy".
        healthy: of (model, data): [] bool. An episode terminates where it is false; None: always healthy.
        reward_terms: the terms whose sum is the reward. That of the paper's authors is the sum of these two.
        contact: of `cfrc_ext` [nbody, 6]: [] contact cost; None: 0.
        cost_quantity: of `CostInputs`: []; a step costs 1 where it exceeds the threshold, else 0.
        qpos_noise: an episode starts at the model's qpos0 plus uniform noise of this half-width,
        qvel_noise: and with a velocity that is uniform noise of this half-width,
        qvel_normal: or, if this is set, normal noise of that standard deviation.
        fields: derived `MjData` arrays that this row's own functions read.
        observe: of (model, data): [obs_dim], in place of the usual observation.
        reward: of (model, data, action): named terms, [] each, whose sum is the reward.
        start: of (model, key): qpos [nq] and qvel [nv] that an episode starts with.
        view: from where films show the robot: the "side", along the y axis, or "above".
    """

    xml: str
    frame_skip: int
    num_hidden: int = 0
    velocity_clip: float | None = None
    extra_obs: tuple[tuple[str, int], ...] = ()
    track: str | None = None
    displacement: OfData | None = None
    forward_weight: float = 1.0
    control_weight: float = 0.0
    healthy_reward: float = 0.0
    healthy: OfData | None = None
    reward_terms: tuple[str, ...] = ("forward", "healthy")
    contact: Callable[[jax.Array], jax.Array] | None = None
    cost_quantity: Callable[[CostInputs], jax.Array]
    qpos_noise: float = 0.0
    qvel_noise: float = 0.0
    qvel_normal: bool = False
    fields: tuple[str, ...] = ()
    observe: OfData | None = None
    reward: Rewards | None = None
    start: Start | None = None
    view: Literal["side", "above"] = "side"


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
