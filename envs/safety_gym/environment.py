"""The Safety Gym tasks as environments: layouts, physics and terms put together in safety-gymnasium's order."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.spatial.transform import Rotation
from jax.typing import ArrayLike

from envs import physics as physics_lib
from envs.base import State, check_shape, executed, first_state, next_state
from envs.engines import find_engine
from envs.jax_tools import compute_where
from envs.physics import Mocap
from envs.safety_gym import layout as layouts
from envs.safety_gym import mirror as mirrors
from envs.safety_gym import scene as scenes
from envs.safety_gym.lidar import lidar
from envs.safety_gym.robots import ROBOTS
from envs.safety_gym.tasks import TABLE
from envs.safety_gym.terms import AIMS, COSTS, Situation

BUTTON_PAUSE = 10  # control steps after a right press without button cost and button lidar
CIRCLE = 0.35  # m, radius of the circles on which gremlins move; one round takes them 2 pi seconds
FLIGHT = 0.2  # m, height of the gremlins' targets above the floor


@struct.dataclass(kw_only=True)
class World:
    """`State.physics`: the engine's state and what the engine does not know."""

    data: physics_lib.Data
    layout: jax.Array  # [P, 2] m, places of the robot and of every object at reset; the goal's is the current one
    mocap_quat: jax.Array | None  # [num_mocap, 4]; None without mocap bodies (no array of size 0 can be saved)
    goal_button: jax.Array  # [] int32
    timer: jax.Array  # [] int32 control steps
    distances: dict[str, jax.Array]  # m, [] each: the next step's reward is the decrease from these
    ticks: jax.Array  # [] int32 engine steps since reset, from which the gremlins' places follow
    key: jax.Array  # the random key of the goals to come


class SafetyGym:
    """A level-1 task of safety-gymnasium 1.0.0 as an `Environment`; observations have the original's order.

    `State.terms` has, by the name of each distance of the task's aim, the decrease of that distance in m; then "bonus",
    which is 1 when the aim is met; then, for each of the task's costs, "cost_<name>", which is 0 or 1. `State.cost` is
    1 if any of these costs is.

    Args:
        name: a key of `tasks.TABLE`.
        physics: engine; see `envs.make`.
        max_episode_steps: control steps until truncation.
        num_threads: of the native engine; None shares the usable CPUs among JAX's local devices.
    """

    view = "arena"  # films show a map of it

    def __init__(
        self,
        name: str,
        *,
        physics: str = "auto",
        max_episode_steps: int = 1000,
        num_threads: int | None = None,
    ):
        self.name = name
        self.task = task = TABLE[name]
        self.max_episode_steps = max_episode_steps
        self.scene = scene = scenes.build(task, prisms=find_engine(physics).needs_prisms)
        self.model = model = scene.model
        self.num_substeps = scenes.SUBSTEPS
        self.dt = float(model.opt.timestep) * self.num_substeps
        self.action_dim = model.nu
        self.action_low, self.action_high = model.actuator_ctrlrange.astype("float32").T
        self._kinds = {kind.name: kind for kind in task.objects}
        self._places = layouts.places_of(task)
        self._radii = layouts.keepouts(task)
        self._physics = physics_lib.make_physics(
            physics,
            model,
            num_substeps=self.num_substeps,
            fields=["sensordata"],
            refresh=True,
            num_threads=num_threads,
        )
        self.physics_name = self._physics.name
        hinges, ball = 2 * len(scene.hinge_qpos), 9 * (scene.ball_qpos is not None)
        self.obs_dim = scene.num_observed + hinges + ball + 16 * len(task.lidars)
        # Gremlins circle to the left. In the mirror they would circle to the right, which is another task.
        symmetric = not any(kind.circling for kind in task.objects)
        actuators = [model.actuator(i).name for i in range(model.nu)]
        self.mirror = mirrors.make(ROBOTS[task.robot], actuators, len(task.lidars)) if symmetric else None

    def reset(self, key: jax.Array) -> State:
        """Starts an episode with a layout of its own; `key` is consumed."""
        layout_key, yaw_key, goal_key, key = jax.random.split(key, 4)
        layout = layouts.sample(self.task, layout_key)
        yaws = jax.random.uniform(yaw_key, (len(layout),), maxval=2 * np.pi)
        goal_button = jnp.zeros((), jnp.int32)
        if self.task.aim == "button":
            goal_button = jax.random.randint(goal_key, (), 0, self._kinds["buttons"].count)
        qpos, mocap_quat = self._initial_poses(layout, yaws)
        qvel = jnp.zeros(self.model.nv)
        return self.reset_to(layout, qpos, qvel, mocap_quat=mocap_quat, goal_button=goal_button, key=key)

    def reset_to(
        self,
        layout: ArrayLike,
        qpos: ArrayLike,
        qvel: ArrayLike,
        *,
        mocap_quat: ArrayLike | None = None,
        goal_button: ArrayLike = 0,
        timer: ArrayLike = 0,
        ticks: ArrayLike = 0,
        key: jax.Array | None = None,
    ) -> State:
        """Starts an episode in a given situation.

        Args:
            layout: `[P, 2]` m, places of robot and objects, in the order of `layout.places_of`. The rows of the robot,
                the vases and the push box are not read, because the engine has these in `qpos`. The goal's row is not
                read in a button task, because there the goal is on the button to press.
            qpos: `[nq]`.
            qvel: `[nv]`.
            mocap_quat: `[num_mocap, 4]`, orientations of the mocap bodies: those of the gremlins' targets, and the
                identity for all others. By default all are the identity.
            goal_button: `[]` int, index of the button to press.
            timer: `[]` int, control steps that are left of the pause after a right press.
            ticks: `[]` int, engine steps since the episode began.
            key: the random key of the goals to come; consumed. By default that of seed 0.
        """
        check_shape(f"{self.name}: layout", layout, (len(self._radii), 2))
        check_shape(f"{self.name}: qpos", qpos, (self.model.nq,))
        check_shape(f"{self.name}: qvel", qvel, (self.model.nv,))
        layout = jnp.asarray(layout, jnp.result_type(float))
        if self.task.aim == "button":
            layout = self._with_goal(layout, layout[self._places["buttons"]][goal_button])
        if mocap_quat is None:
            mocap_quat = jnp.zeros((self.model.nmocap, 4)).at[:, 0].set(1.0)
        check_shape(f"{self.name}: mocap_quat", mocap_quat, (self.model.nmocap, 4))
        mocap_quat = jnp.asarray(mocap_quat, layout.dtype)
        ticks = jnp.asarray(ticks, jnp.int32)
        mocap = Mocap(pos=self._mocap_path(layout, ticks)[0], quat=mocap_quat) if self.model.nmocap else None
        world = World(
            data=self._physics.init(qpos, qvel, mocap),
            layout=layout,
            mocap_quat=mocap_quat if self.model.nmocap else None,
            goal_button=jnp.asarray(goal_button, jnp.int32),
            timer=jnp.asarray(timer, jnp.int32),
            distances={},
            ticks=ticks,
            key=jax.random.key(0) if key is None else key,
        )
        world = dataclasses.replace(world, distances=AIMS[self.task.aim].distances(self.situation(world)))
        terms = [*world.distances, "bonus", *(f"cost_{name}" for name in self.task.costs)]
        return first_state(world, self.observe(world), terms)

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step. See `Environment.step`."""
        aim, world = AIMS[self.task.aim], state.physics
        world = self._advance(world, executed(self, action))
        situation = self.situation(world)
        distances, met = aim.distances(situation), aim.met(situation)
        terms = {name: world.distances[name] - distances[name] for name in distances}
        terms["bonus"] = met.astype(state.reward.dtype)
        reward = sum(terms.values(), start=jnp.zeros_like(state.reward))
        charged = {name: COSTS[name](situation) for name in self.task.costs}
        cost = jnp.stack(list(charged.values())).any().astype(state.cost.dtype)
        world = self._aim_anew(world, met)
        obs = self.observe(world)
        finite = jnp.isfinite(obs).all() & jnp.isfinite(reward)
        return next_state(
            state,
            physics=world,
            obs=obs,
            reward=reward,
            cost=cost,
            terminated=jnp.zeros((), bool),
            terms=terms | {f"cost_{name}": value.astype(reward.dtype) for name, value in charged.items()},
            max_episode_steps=self.max_episode_steps,
            finite=finite,
        )

    def engine_arrays(self, state: State) -> dict[str, jax.Array]:
        """The `MjData` arrays, by name, from which C MuJoCo draws a state or steps on."""
        world = state.physics
        arrays = {"qpos": world.data.qpos, "qvel": world.data.qvel}
        if world.mocap_quat is None:
            return arrays
        pos = self._mocap_path(world.layout, world.ticks)[0]
        return arrays | {"mocap_pos": pos, "mocap_quat": world.mocap_quat}

    def _advance(self, world: World, ctrl: jax.Array) -> World:
        """The world after the engine's substeps. Goal and timer are still those from before."""
        mocap = None
        if world.mocap_quat is not None:
            path = self._mocap_path(world.layout, world.ticks)
            mocap = Mocap(pos=path if self._circling else path[0], quat=world.mocap_quat)
        data = self._physics.step(world.data, ctrl, mocap)
        return dataclasses.replace(world, data=data, ticks=world.ticks + scenes.SUBSTEPS)

    def _aim_anew(self, world: World, met: jax.Array) -> World:
        """The world with the pause one step shorter and, if the aim was met, with the next goal and its distances."""
        key, goal_key = jax.random.split(world.key)
        timer = jnp.maximum(world.timer - 1, 0)
        goal_button = world.goal_button
        if self.task.aim == "button":
            drawn = jax.random.randint(goal_key, (), 0, self._kinds["buttons"].count)
            goal_button = jnp.where(met, drawn, goal_button)
            timer = jnp.where(met, BUTTON_PAUSE, timer)
            goal = world.layout[self._places["buttons"]][goal_button]
        else:
            goal = compute_where(met, self._draw_goal, world.layout[self._places["goal"]][0], world, goal_key)
        world = dataclasses.replace(
            world, layout=self._with_goal(world.layout, goal), goal_button=goal_button, timer=timer, key=key
        )
        return dataclasses.replace(world, distances=AIMS[self.task.aim].distances(self.situation(world)))

    def _draw_goal(self, world: World, key: jax.Array) -> jax.Array:
        """A goal [2], uniform on the area that is clear of the robot and the objects where they are now."""
        now = world.layout.at[0].set(self._robot_pose(world.data)[0][:2])
        for name in self.scene.free_qpos:
            now = now.at[self._places[name]].set(self._centres(world, name)[:, :2])
        others = np.delete(np.arange(len(self._radii)), self._places["goal"].start)
        row = self._places["goal"].start
        return layouts.draw_goal(key, now[row], float(self._radii[row]), now[others], self._radii[others])

    def _with_goal(self, layout: jax.Array, goal: jax.Array) -> jax.Array:
        return layout.at[self._places["goal"]].set(goal)

    @property
    def _circling(self) -> bool:
        return any(kind.circling for kind in self.task.objects)

    def _mocap_path(self, layout: jax.Array, ticks: jax.Array) -> jax.Array:
        """[SUBSTEPS, num_mocap, 3]: where the mocap bodies are in each of the substeps from `ticks` on."""
        seconds = (ticks + jnp.arange(scenes.SUBSTEPS, dtype=ticks.dtype)).astype(layout.dtype)
        angle = seconds * self.model.opt.timestep
        course = CIRCLE * jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=1)
        path = jnp.zeros((scenes.SUBSTEPS, self.model.nmocap, 3), layout.dtype)
        for name, rows in self.scene.mocap.items():
            kind, centres = self._kinds[name], layout[self._places[name]]
            places = centres[None] + course[:, None] if kind.circling else centres[None]
            path = path.at[:, rows, :2].set(places).at[:, rows, 2].set(FLIGHT if kind.circling else kind.height)
        return path

    def _initial_poses(self, layout: jax.Array, yaws: jax.Array) -> tuple[jax.Array, jax.Array]:
        """qpos `[nq]` and mocap_quat `[num_mocap, 4]` of bodies that stand upright at their places, turned by yaws."""
        qpos = jnp.asarray(self.model.qpos0, layout.dtype)
        if self.scene.robot.planar:
            qpos = qpos.at[:3].set(jnp.array([*layout[0], yaws[0]]))
        else:
            qpos = qpos.at[:2].set(layout[0]).at[3:7].set(_turned(yaws[0]))
        mocap_quat = jnp.zeros((self.model.nmocap, 4), layout.dtype).at[:, 0].set(1.0)
        for name, starts in self.scene.free_qpos.items():
            quats = jax.vmap(_turned)(yaws[self._places[name]])
            qpos = qpos.at[starts[:, None] + np.arange(2)].set(layout[self._places[name]])
            qpos = qpos.at[starts[:, None] + np.arange(3, 7)].set(quats)
            if self._kinds[name].circling:
                mocap_quat = mocap_quat.at[self.scene.mocap[name]].set(quats)
        return qpos, mocap_quat

    def _robot_pose(self, data: physics_lib.Data) -> tuple[jax.Array, jax.Array]:
        """Position [3] and rotation [3, 3] of the root body."""
        if self.scene.robot.planar:
            pos = jnp.append(data.qpos[:2], self.scene.robot.height)
            sine, cosine = jnp.sin(data.qpos[2]), jnp.cos(data.qpos[2])
            return pos, jnp.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return data.qpos[:3], _rotation(data.qpos[3:7])

    def _centres(self, world: World, name: str) -> jax.Array:
        """[count, 3] m: the centres of a kind's objects, from the engine if they move freely, else from the layout."""
        if name in self.scene.free_qpos:
            return world.data.qpos[self.scene.free_qpos[name][:, None] + np.arange(3)]
        places = world.layout[self._places[name]]
        return jnp.concatenate([places, jnp.full_like(places[:, :1], self._kinds[name].height)], axis=1)

    def situation(self, world: World) -> Situation:
        """Where everything is: what rewards, costs and pictures are made from."""
        contacts = world.data.fields["sensordata"]
        centres = {name: self._centres(world, name) for name in self._kinds}
        return Situation(
            robot=self._robot_pose(world.data)[0],
            objects=centres,
            sizes={name: kind.size for name, kind in self._kinds.items()},
            goal=centres["goal"][0],
            goal_button=world.goal_button,
            timer=world.timer,
            touched={name: contacts[entries] > 0 for name, entries in self.scene.contacts.items()},
        )

    def observe(self, world: World) -> jax.Array:
        """`[obs_dim]`: the sensors, the ball joint's rotation, the hinges' angles, then one lidar for each kind."""
        scene, qpos = self.scene, world.data.qpos
        pos, rotation = self._robot_pose(world.data)
        parts = [world.data.fields["sensordata"][: scene.num_observed]]
        if scene.ball_qpos is not None:
            parts.append(_rotation(qpos[scene.ball_qpos : scene.ball_qpos + 4]).ravel())
        if len(scene.hinge_qpos):
            angles = qpos[scene.hinge_qpos]
            parts.append(jnp.stack([jnp.sin(angles), jnp.cos(angles)], axis=1).ravel())
        for name in self.task.lidars:
            seen = lidar(pos, rotation, self._centres(world, name)[:, :2])
            parts.append(jnp.where(world.timer == 0, seen, 0.0) if name == "buttons" else seen)
        return jnp.concatenate(parts)


def _turned(yaw: jax.Array) -> jax.Array:
    """The quaternion of a turn about the vertical."""
    return jnp.array([jnp.cos(yaw / 2), 0.0, 0.0, jnp.sin(yaw / 2)])


def _rotation(quat: jax.Array) -> jax.Array:
    """[3, 3] of a quaternion (w, x, y, z) of any length."""
    return Rotation.from_quat(jnp.roll(quat, -1)).as_matrix()
