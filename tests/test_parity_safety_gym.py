"""Safety Gym tasks against states that safety-gymnasium 1.0.0 recorded (`tests/golden/record_safety_gym.py`).

All in float64: from the original's state after a control step, our functions give its observation, reward and cost.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import physics
from envs.base import State
from envs.physics.native import NativePhysics
from envs.safety_gym import environment, layout
from envs.safety_gym.environment import SafetyGym, World
from envs.safety_gym.tasks import TABLE
from envs.safety_gym.terms import AIMS, COSTS

pytestmark = pytest.mark.once

FOLDER = Path(__file__).parent / "golden" / "safety_gym"
LAST_DISTANCES = {  # aim -> our name of a distance -> the recorder's
    "goal": {"goal_distance": "last_dist_goal"},
    "button": {"goal_distance": "last_dist_goal"},
    "push": {"box_distance": "last_dist_box", "goal_distance": "last_box_goal"},
}


@dataclasses.dataclass(frozen=True)
class Recording:
    """What the original did, in our coordinates; [R] records."""

    env: SafetyGym
    data: dict[str, np.ndarray]
    qpos: np.ndarray  # [R, nq] before the step
    qvel: np.ndarray
    next_qpos: np.ndarray  # [R, nq] after the step
    next_qvel: np.ndarray
    layout: np.ndarray  # [R, P, 2] with the goal in force during the step
    next_layout: np.ndarray
    mocap_quat: np.ndarray  # [R, num_mocap, 4]


@pytest.fixture(scope="module", params=list(TABLE))
def recording(request: pytest.FixtureRequest) -> Recording:
    with jax.enable_x64(True):
        env = SafetyGym(request.param, physics="native", num_threads=1)
    return convert(env, load(FOLDER / f"{request.param}.npz"))


def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def convert(env: SafetyGym, data: dict[str, np.ndarray]) -> Recording:
    """The original's coordinates into ours: the Point's joints are relative to where it started, its objects follow."""
    episode = data["episode"]
    poses = {name: ours(env, data, data[name], episode) for name in ("qpos", "next_qpos")}
    speeds = {name: data[name].copy() for name in ("qvel", "next_qvel")}
    if env.scene.robot.planar:
        for name, speed in speeds.items():
            speed[:, :2] = turn(data["robot_init"][episode, 2], data[name][:, :2])
    places = np.zeros((len(episode), len(layout.keepouts(env.task)), 2))
    rows = layout.places_of(env.task)
    for name in ("hazards", "buttons", "gremlins", "pillars"):
        if name in rows:
            places[:, rows[name]] = data[f"layout_{name}"][episode][..., :2]
    before, after = places.copy(), places.copy()
    before[:, rows["goal"]] = data["goal_pos"][:, None, :2]
    after[:, rows["goal"]] = data["next_goal_pos"][:, None, :2]
    quat = np.tile([1.0, 0, 0, 0], (len(episode), env.model.nmocap, 1))
    if "gremlins" in rows:
        quat[:, env.scene.mocap["gremlins"]] = data["gremlin_quat"][episode]
    return Recording(env=env, data=data, **poses, **speeds, layout=before, next_layout=after, mocap_quat=quat)


def ours(env: SafetyGym, data: dict[str, np.ndarray], qpos: np.ndarray, episode: np.ndarray) -> np.ndarray:
    qpos = qpos.copy()
    if env.scene.robot.planar:
        start = data["robot_init"][episode]
        qpos[:, :2] = start[:, :2] + turn(start[:, 2], qpos[:, :2])
        qpos[:, 2] += start[:, 2]
    return qpos


def turn(angle: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    sine, cosine = np.sin(angle), np.cos(angle)
    x, y = vectors.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


def worlds(recording: Recording) -> World:
    """[R] worlds after the step, the goal still the one in force during it; sensors by C MuJoCo's forward pass."""
    env, data, count = recording.env, recording.data, len(recording.qpos)
    simulation, sensors = mujoco.MjData(env.model), np.zeros((count, env.model.nsensordata))
    ticks = np.round(data["next_time"] / env.model.opt.timestep).astype(np.int32)
    for i in range(count):
        simulation.qpos[:], simulation.qvel[:] = recording.next_qpos[i], recording.next_qvel[i]
        simulation.ctrl[:] = np.clip(data["action"][i], -1, 1)
        if env.model.nmocap:
            path = np.asarray(env._mocap_path(jnp.asarray(recording.layout[i]), ticks[i] - 10))
            simulation.mocap_pos[:], simulation.mocap_quat[:] = path[-1], recording.mocap_quat[i]
        simulation.qacc_warmstart[:] = 0
        mujoco.mj_forward(env.model, simulation)
        sensors[i] = simulation.sensordata
    return World(
        data=physics.Data(
            qpos=jnp.asarray(recording.next_qpos),
            qvel=jnp.asarray(recording.next_qvel),
            fields={"sensordata": jnp.asarray(sensors)},
            change={},
            backend=jnp.zeros(count),
        ),
        layout=jnp.asarray(recording.layout),
        mocap_quat=jnp.asarray(recording.mocap_quat) if env.model.nmocap else None,
        goal_button=jnp.asarray(data["goal_button"]),
        timer=jnp.asarray(data["timer"]),
        distances={ours: jnp.asarray(data[theirs]) for ours, theirs in LAST_DISTANCES[env.task.aim].items()},
        ticks=jnp.asarray(ticks),
        key=jnp.zeros(count),
    )


def feels_contacts(env: SafetyGym) -> np.ndarray:
    """[obs_dim] bool: what the accelerometer and the touch sensors give."""
    chosen = np.zeros(env.obs_dim, bool)
    kinds = [int(mujoco.mjtSensor.mjSENS_ACCELEROMETER), int(mujoco.mjtSensor.mjSENS_TOUCH)]
    for kind, start, width in zip(env.model.sensor_type, env.model.sensor_adr, env.model.sensor_dim, strict=True):
        if start < env.scene.num_observed and kind in kinds:
            chosen[start : start + width] = True
    return chosen


def without_contacts(data: dict[str, np.ndarray]) -> np.ndarray:
    """[R] bool: no object touched the robot or another object."""
    free = ~data["any_object_contact"]
    if "gremlin_floor_contact" in data:  # pruned here: gremlins rise from the floor in the first steps
        free &= ~data["gremlin_floor_contact"]
    return free


def test_observations_reward_cost_and_goals_from_recorded_states(recording: Recording) -> None:
    with jax.enable_x64(True):
        env, data = recording.env, recording.data
        world = worlds(recording)
        situation = jax.vmap(env.situation)(world)
        aim = AIMS[env.task.aim]
        distances, met = jax.vmap(aim.distances)(situation), np.asarray(jax.vmap(aim.met)(situation))
        reward = sum(np.asarray(world.distances[name] - distances[name]) for name in distances) + met
        charged: dict[str, Any] = {name: np.asarray(jax.vmap(COSTS[name])(situation)) for name in env.task.costs}
        after = dataclasses.replace(
            world,
            layout=jnp.asarray(recording.next_layout),
            goal_button=jnp.asarray(data["next_goal_button"]),
            timer=jnp.asarray(data["next_timer"]),
        )
        obs = np.asarray(jax.vmap(env.observe)(after))
    np.testing.assert_array_equal(met, data["goal_met"])
    np.testing.assert_allclose(reward, data["reward"], rtol=1e-5, atol=1e-9)
    for name, value in charged.items():
        recorded = np.nan_to_num(data[f"cost_{name}"])
        np.testing.assert_array_equal(value, recorded > 0, err_msg=name)
    np.testing.assert_array_equal(np.any(list(charged.values()), axis=0), data["cost"])
    assert obs.shape == data["obs"].shape
    of_contacts = feels_contacts(env)
    np.testing.assert_allclose(obs[:, ~of_contacts], data["obs"][:, ~of_contacts], atol=1e-9)
    # Between objects, MuJoCo 2.3.3 and 3.17 find other contact points; with the floor the solvers' tolerance counts.
    free = without_contacts(data)
    felt, theirs = obs[free][:, of_contacts], data["obs"][free][:, of_contacts]
    error = (np.abs(felt - theirs) / (1 + np.abs(theirs))).max(axis=1)
    assert np.quantile(error, 0.95) < 1e-9
    assert error.max() < 1e-4


# Of the robot's velocity after a control step without contacts between objects: median, 90 %, 99 %. The original ran
# MuJoCo 2.3.3: where the solver stops at its tolerance, as under Car's wheels, 3.17 and it part.
BOUNDS = {"Point": (1e-13, 1e-11, 1e-9), "Car": (1e-13, 1e-11, 10.0), "Doggo": (1e-13, 1e-11, 1e-4)}


def warmly_started(env: SafetyGym, state: State, warm_start: np.ndarray) -> State:
    """`state` with the original's first guess for the solver, the last of what the engine keeps of a step."""
    rows = np.asarray(state.physics.data.backend).view(np.float64).copy()
    end = cast(NativePhysics, env._physics)._num_state
    rows[:, end - env.model.nv : end] = warm_start
    data = dataclasses.replace(state.physics.data, backend=jnp.asarray(rows.view(np.uint32)))
    return dataclasses.replace(state, physics=dataclasses.replace(state.physics, data=data))


def errors_of_steps(recording: Recording, env: SafetyGym, chosen: np.ndarray) -> np.ndarray:
    """Errors of the robot's velocity after a control step of `env` from recorded states, for the `chosen` indices."""
    data, scene = recording.data, env.scene
    ticks = np.round(data["time"] / env.model.opt.timestep).astype(np.int32)

    def reset(qpos: Any, qvel: Any, layout: Any, quat: Any, ticks: Any) -> State:
        return env.reset_to(layout, qpos, qvel, mocap_quat=quat, ticks=ticks)

    starts = (recording.qpos, recording.qvel, recording.layout, recording.mocap_quat, ticks)
    state = jax.jit(jax.vmap(reset))(*[jnp.asarray(x[chosen]) for x in starts])
    if env.physics_name == "native":
        state = warmly_started(env, state, data["qacc_warmstart"][chosen])
    qvel = jax.jit(jax.vmap(env.step))(state, jnp.asarray(data["action"][chosen])).physics.data.qvel
    robot = slice(0, env.model.nv - 6 * sum(map(len, scene.free_qpos.values())))
    error: np.ndarray = np.abs(np.asarray(qvel) - recording.next_qvel[chosen])[:, robot].max(axis=1)
    return error


def test_one_control_step_without_contacts_between_objects(recording: Recording) -> None:
    chosen = np.flatnonzero(without_contacts(recording.data))
    assert len(chosen) > 100
    with jax.enable_x64(True):
        error = errors_of_steps(recording, recording.env, chosen)
    quantiles = np.quantile(error, [0.5, 0.9, 0.99])
    assert (quantiles <= BOUNDS[recording.env.scene.robot.name]).all(), quantiles


# Where the original ran on this project's MuJoCo, contacts make no difference beyond the tolerance of solvers; that of
# a pillar (cylinder) and a box is found by iteration. Median, 90 % and largest error of the robot's velocity.
CONTACT_BOUNDS = {"Goal1": (1e-13, 1e-12, 1e-10), "Button1": (1e-13, 1e-10, 1e-2), "Push1": (1e-13, 1e-3, 0.5)}


@pytest.mark.parametrize("name", list(TABLE))
def test_one_control_step_with_contacts_on_the_same_engine(name: str) -> None:
    with jax.enable_x64(True):
        env = SafetyGym(name, physics="native", num_threads=1)
        recording = convert(env, load(FOLDER / "mujoco_3.17" / f"{name}.npz"))
        chosen = np.flatnonzero(recording.data["any_object_contact"])
        error = errors_of_steps(recording, env, chosen)
    assert len(chosen) > 20
    quantiles = np.quantile(error, [0.5, 0.9, 1.0])
    assert (quantiles <= CONTACT_BOUNDS[name.removeprefix(env.task.robot)]).all(), quantiles


# In float32; Car's wheels rest on a solver that stops at its tolerance.
MJX_BOUNDS = {
    "PointGoal1": (1e-6, 1e-4),
    "PointButton1": (1e-6, 2e-4),
    "PointPush1": (1e-6, 1e-4),
    "CarGoal1": (2e-4, 5e-3),
    "CarButton1": (2e-4, 5e-3),
    "CarPush1": (2e-4, 5e-3),
    "DoggoGoal1": (5e-5, 2e-3),
    "DoggoButton1": (5e-5, 2e-3),
}


@pytest.mark.slow  # mjx: 2 to 4 minutes of compilation each
@pytest.mark.parametrize("physics", ["mjx", "warp"])
@pytest.mark.parametrize("recording", MJX_BOUNDS, indirect=True)
def test_one_control_step_on_an_accelerators_engine(recording: Recording, physics: str) -> None:
    env = SafetyGym(recording.env.name, physics=physics)
    chosen = np.flatnonzero(without_contacts(recording.data))[:128]
    quantiles = np.quantile(errors_of_steps(recording, env, chosen), [0.5, 0.9])
    assert (quantiles <= MJX_BOUNDS[env.name]).all(), quantiles
    touched = jax.jit(jax.vmap(lambda *state: env.situation(env.reset_to(*state).physics).touched))(
        recording.layout, recording.next_qpos, recording.next_qvel
    )
    for kind, found in touched.items():  # MJX may miss a shallow contact of a ball and a cylinder (Doggo's torso)
        assert np.mean(found != recording.data[f"touch_{kind.removesuffix('s')}"]) < 2e-3, kind


def test_metadata_say_where_the_recordings_are_from() -> None:
    for name in TABLE:
        with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as file:
            facts = json.loads(str(file["metadata"]))
        assert facts["versions"]["safety-gymnasium"] == "1.0.0"
        assert facts["task"] == f"Safety{name}-v0"
    assert environment.BUTTON_PAUSE == 10
