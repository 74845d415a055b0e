"""Swimmer, HalfCheetah, Hopper, Walker2d, Ant, Humanoid as gymnasium's `-v5`, with the paper authors' 0/1 cost.

Where they depart from `-v5`, on purpose:
* observations hold no external contact forces (Ant 27, Humanoid 270 entries);
* actions are clipped to the control range first, so that costs see what the engine sees;
* the reward is the authors' ("reward used" below): forward and healthy terms, the control cost only where they
  keep it (Swimmer, Walker2d), never the contact cost;
* the cost is 1 where the task's quantity exceeds `cost_threshold`, else 0.
"""

import importlib.util
import pathlib

import jax
import jax.numpy as jnp
import mujoco
from jax.typing import ArrayLike

from envs import physics as physics_lib
from envs.base import State, check_shape, executed, first_state, next_state
from envs.locomotion_tasks import TABLE, CostInputs
from envs.registry import TASKS


class Locomotion:
    """See `Environment`.

    `State.terms` has gymnasium's four reward terms ("forward", "healthy", "control", "contact", the last two <= 0),
    all of them whether or not the task's reward sums them, so that they can be compared and plotted.

    A simulation that turns non-finite terminates with reward and cost 0 and the offending observations at 0: MuJoCo
    itself would put it back to its start unseen, and one NaN would spoil the learner's whole batch.

    Args:
        name: a key of `TASKS` of the locomotion family.
        physics: backend; see `envs.make`.
        cost_threshold: of the task's quantity; None takes the task's default.
        contact_cost: whether the contact term counts in the cost (Ant, Humanoid). With the simulator of the
            paper's authors it was zero; without it no contact forces are computed.
        max_episode_steps: control steps until truncation.
        num_threads: of the native backend; None shares the usable CPUs among the local devices.
    """

    def __init__(
        self,
        name: str,
        *,
        physics: str = "auto",
        cost_threshold: float | None = None,
        contact_cost: bool = True,
        max_episode_steps: int = 1000,
        num_threads: int | None = None,
    ):
        self.name = name
        self.task = task = TABLE[name]
        self.cost_threshold = TASKS[name].options["cost_threshold"] if cost_threshold is None else cost_threshold
        self.max_episode_steps = max_episode_steps
        self.model = model = load_model(task.xml)
        self.num_substeps = task.frame_skip
        self.dt = float(model.opt.timestep) * self.num_substeps
        self.obs_dim, self.action_dim = TASKS[name].obs_dim, TASKS[name].action_dim
        self.action_low, self.action_high = model.actuator_ctrlrange.astype("float32").T
        self._contact = task.contact if contact_cost else None
        fields = [field for field, _ in task.extra_obs] + ["cfrc_ext"] * (self._contact is not None)
        self._physics = physics_lib.make_physics(
            physics,
            model,
            num_substeps=self.num_substeps,
            fields=fields,
            track=[task.track],
            num_threads=num_threads,
        )
        self.physics_name = self._physics.name

    def reset(self, key: jax.Array) -> State:
        """Starts an episode near the model's initial pose; `key` is consumed."""
        qpos_key, qvel_key = jax.random.split(key)
        model, task = self.model, self.task
        noise = jax.random.uniform(qpos_key, (model.nq,), minval=-task.qpos_noise, maxval=task.qpos_noise)
        if task.qvel_normal:
            qvel = task.qvel_noise * jax.random.normal(qvel_key, (model.nv,))
        else:
            qvel = jax.random.uniform(qvel_key, (model.nv,), minval=-task.qvel_noise, maxval=task.qvel_noise)
        return self.reset_to(jnp.asarray(model.qpos0, noise.dtype) + noise, qvel)

    def reset_to(self, qpos: ArrayLike, qvel: ArrayLike) -> State:
        """Starts an episode at `qpos` `[nq]`, `qvel` `[nv]`."""
        check_shape(f"{self.name}: qpos", qpos, (self.model.nq,))
        check_shape(f"{self.name}: qvel", qvel, (self.model.nv,))
        data = self._physics.init(qpos, qvel)
        return first_state(data, self._observe(data), ("forward", "healthy", "control", "contact"))

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step. See `Environment.step`."""
        action = executed(self, action)
        data = self._physics.step(state.physics, action)
        obs = self._observe(data)
        velocity, terms = self._terms(data, action)
        reward = sum((terms[name] for name in self.task.reward_terms), start=jnp.zeros_like(state.reward))
        quantity = self.task.cost_quantity(
            CostInputs(velocity=velocity, control_cost=-terms["control"], contact_cost=-terms["contact"])
        )
        cost = (quantity > self.cost_threshold).astype(state.cost.dtype)
        finite = jnp.isfinite(obs).all() & jnp.isfinite(reward) & jnp.isfinite(quantity)
        return next_state(
            state,
            physics=data,
            obs=obs,
            reward=reward,
            cost=cost,
            terminated=~self._healthy(data),
            terms=terms,
            max_episode_steps=self.max_episode_steps,
            finite=finite,
        )

    def engine_arrays(self, state: State) -> dict[str, jax.Array]:
        """The `MjData` arrays, by name, from which C MuJoCo draws a state or steps on."""
        return {"qpos": state.physics.qpos, "qvel": state.physics.qvel}

    def _healthy(self, data: physics_lib.Data) -> jax.Array:
        healthy = self.task.healthy
        return jnp.ones((), bool) if healthy is None else healthy(data.qpos, data.qvel)

    def _terms(self, data: physics_lib.Data, action: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The root's velocity `[2]` in m/s and gymnasium's reward terms."""
        task = self.task
        velocity = task.displacement(self.model, data) / self.dt
        contact = jnp.zeros_like(velocity[0]) if self._contact is None else self._contact(data.fields["cfrc_ext"])
        return velocity, {
            "forward": task.forward_weight * velocity[0],
            "healthy": task.healthy_reward * self._healthy(data).astype(velocity.dtype),
            "control": -task.control_weight * jnp.square(action).sum().astype(velocity.dtype),
            "contact": -contact,
        }

    def _observe(self, data: physics_lib.Data) -> jax.Array:
        """`[obs_dim]`: positions, velocities and the task's derived arrays."""
        task, qvel = self.task, data.qvel
        if task.velocity_clip is not None:
            qvel = jnp.clip(qvel, -task.velocity_clip, task.velocity_clip)
        extra = [data.fields[name][first:].ravel() for name, first in task.extra_obs]
        return jnp.concatenate([data.qpos[task.num_hidden :], qvel, *extra])


def load_model(xml: str) -> mujoco.MjModel:
    """Loads a model file from the installed gymnasium's assets.

    The compiler's deprecation warnings about these files are dropped: MuJoCo would also write them to a log file in
    the working directory.

    Raises:
        ImportError: gymnasium is not installed.
    """
    package = importlib.util.find_spec("gymnasium")  # located, not imported: only its files are needed
    if package is None or package.origin is None:
        raise ImportError("the locomotion tasks need the model files of the package gymnasium: install it")
    path = pathlib.Path(package.origin).parent / "envs" / "mujoco" / "assets" / xml
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    finally:
        mujoco.set_mju_user_warning(None)
