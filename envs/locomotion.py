"""Swimmer, HalfCheetah, Hopper, Walker2d, Ant, Humanoid as gymnasium's `-v5`, with the paper authors' 0/1 cost.

They differ from `-v5`, on purpose, in this:
* observations have no external contact forces (so Ant's have 27 entries, Humanoid's 270);
* actions are clipped to the control range first, so that costs depend on the actions that the engine gets;
* the reward is that of the authors: the forward and healthy terms, the control cost only where they keep it (Swimmer,
  Walker2d), never the contact cost;
* there is a cost, which is 1 where the task's quantity exceeds `cost_threshold`, else 0.

A task of your own is a `LocomotionTask` of your own: `Locomotion(row, name="Mine", cost_threshold=1.0)`. A function
that returns it can be registered by `envs.register`.
"""

import importlib.util
import pathlib
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from envs import physics as physics_lib
from envs.base import State, check_shape, executed, first_state, next_state
from envs.locomotion_tasks import TABLE, CostInputs, LocomotionTask


class Locomotion:
    """A row of the table as an `Environment`.

    `State.terms` has the named terms of the row's own reward where it has one. Otherwise it has gymnasium's four
    ("forward", "healthy", "control", "contact", the last two <= 0), whether or not the task's reward sums them, so
    that they can be compared and plotted.

    Where the physics yields NaN or infinity, the episode terminates with reward and cost 0, and the observations that
    are not finite are shown as 0. MuJoCo itself would put the simulation back to its start and say nothing, and one
    NaN would spoil the learner's whole batch.

    Args:
        task: the row: one of `TABLE`, or a `LocomotionTask` of your own.
        name: of the environment, for messages and records.
        physics: engine; see `envs.make`.
        cost_threshold: a step costs 1 where the row's quantity exceeds this, else 0.
        contact_cost: whether the contact term counts in the cost. With the simulator of the paper's authors it was
            zero. Without it no contact forces are computed.
        max_episode_steps: control steps until truncation.
        num_threads: of the native engine; None shares the usable CPUs among JAX's local devices.

    Raises:
        ValueError: `contact_cost` is False and the row has no contact term; or see `envs.physics.make_physics`.
    """

    def __init__(
        self,
        task: LocomotionTask,
        *,
        name: str,
        cost_threshold: float,
        physics: str = "auto",
        contact_cost: bool = True,
        max_episode_steps: int = 1000,
        num_threads: int | None = None,
    ):
        if task.contact is None and not contact_cost:
            raise ValueError(f"{name}: contact_cost False has no effect, its cost counts no contacts; leave it out")
        self.name, self.task, self.cost_threshold = name, task, cost_threshold
        self.max_episode_steps = max_episode_steps
        self.view = task.view
        self.model = model = load_model(task.xml)
        self.num_substeps = task.frame_skip
        self.dt = float(model.opt.timestep) * self.num_substeps
        self.action_dim = model.nu
        self.action_low, self.action_high = model.actuator_ctrlrange.astype("float32").T
        self._contact = task.contact if contact_cost else None
        fields = [field for field, _ in task.extra_obs] + ["cfrc_ext"] * (self._contact is not None)
        fields = list(dict.fromkeys([*fields, *task.fields]))
        track = [] if task.track is None else [task.track]
        self._physics = physics_lib.make_physics(
            physics, model, num_substeps=self.num_substeps, fields=fields, track=track, num_threads=num_threads
        )
        self.physics_name = self._physics.name
        (self.obs_dim,), self._term_names = self._forms(fields, track)

    def _forms(self, fields: list[str], track: list[str]) -> tuple[tuple[int, ...], list[str]]:
        """The shape of an observation and the names of the reward's terms. Nothing is computed, not even physics."""
        template, dtype = mujoco.MjData(self.model), jnp.result_type(float)

        def abstract(name: str) -> Any:
            return jax.ShapeDtypeStruct(np.shape(getattr(template, name)), dtype)

        data = physics_lib.Data(
            qpos=abstract("qpos"),
            qvel=abstract("qvel"),
            fields={name: abstract(name) for name in fields},
            change={name: abstract(name) for name in track},
            backend=(),
        )
        obs = jax.eval_shape(self._observe, data)
        return obs.shape, list(jax.eval_shape(self._reward, data, abstract("ctrl"))[1])

    def reset(self, key: jax.Array) -> State:
        """Starts an episode as the row says, usually near the model's initial pose; `key` is consumed."""
        model, task = self.model, self.task
        if task.start is not None:
            return self.reset_to(*task.start(model, key))
        qpos_key, qvel_key = jax.random.split(key)
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
        return first_state(data, self._observe(data), self._term_names)

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step. See `Environment.step`."""
        action = executed(self, action)
        data = self._physics.step(state.physics, action)
        obs = self._observe(data)
        reward, terms = self._reward(data, action)
        usual = self._usual_terms(data, action)
        quantity = self.task.cost_quantity(
            CostInputs(
                velocity=self._velocity(data),
                control_cost=-usual["control"],
                contact_cost=-usual["contact"],
                data=data,
                action=action,
            )
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
        return jnp.ones((), bool) if healthy is None else healthy(self.model, data)

    def _velocity(self, data: physics_lib.Data) -> jax.Array:
        """The root's velocity `[2]` in m/s."""
        displacement = self.task.displacement
        return jnp.zeros(2, data.qpos.dtype) if displacement is None else displacement(self.model, data) / self.dt

    def _usual_terms(self, data: physics_lib.Data, action: jax.Array) -> dict[str, jax.Array]:
        """Gymnasium's four reward terms."""
        task, velocity = self.task, self._velocity(data)
        contact = jnp.zeros_like(velocity[0]) if self._contact is None else self._contact(data.fields["cfrc_ext"])
        return {
            "forward": task.forward_weight * velocity[0],
            "healthy": task.healthy_reward * self._healthy(data).astype(velocity.dtype),
            "control": -task.control_weight * jnp.square(action).sum().astype(velocity.dtype),
            "contact": -contact,
        }

    def _reward(self, data: physics_lib.Data, action: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The reward `[]` and its named terms."""
        if self.task.reward is not None:
            terms = self.task.reward(self.model, data, action)
            summed: Iterable[str] = terms
        else:
            terms, summed = self._usual_terms(data, action), self.task.reward_terms
        return sum((terms[name] for name in summed), start=jnp.zeros((), data.qpos.dtype)), terms

    def _observe(self, data: physics_lib.Data) -> jax.Array:
        """`[obs_dim]`: the row's own, or positions, velocities and its derived arrays."""
        task, qvel = self.task, data.qvel
        if task.observe is not None:
            return task.observe(self.model, data)
        if task.velocity_clip is not None:
            qvel = jnp.clip(qvel, -task.velocity_clip, task.velocity_clip)
        extra = [data.fields[name][first:].ravel() for name, first in task.extra_obs]
        return jnp.concatenate([data.qpos[task.num_hidden :], qvel, *extra])


def make(name: str, **options: Any) -> Locomotion:
    """A built-in task: the row of `TABLE` under its name. For the options see `Locomotion`."""
    return Locomotion(TABLE[name], name=name, **options)


def load_model(xml: str) -> mujoco.MjModel:
    """Loads a model file from the installed gymnasium's assets.

    MuJoCo's compiler warns that these files are in an old style, and writes that to a log file in the working directory
    too. These warnings are dropped.

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
