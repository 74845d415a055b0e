"""What films show: the engine's bodies and objects, and the episode's own return and cost."""

import dataclasses
import types
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from ccil_jax.acting import networks
from ccil_jax.acting.rollout import Actor
from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.training.filesystem import file_sha256
from envs.locomotion import Locomotion, LocomotionTask
from envs.registry import TASKS, TaskInfo
from experiments.page import episodes, film, video
from experiments.policies import evaluating, policy_file
from experiments.policies.evaluating import Loaded
from experiments.policies.numpy_policy import policies
from tests.probe_envs import Walk

pytestmark = pytest.mark.once

SHIPPED = policy_file.shipped().parent / "demonstrations"


def untrained(task: str, **options: Any) -> Loaded:
    """An untrained policy with two seeds."""
    return untrained_on(envs.make(task, physics="native", **options), TASKS[task])


def untrained_on(env: Any, task: TaskInfo = TASKS["Hopper"]) -> Loaded:
    config = Config(method="trpo", hidden_sizes=(8,))
    params = jax.vmap(networks.policy_of(config, env).init)(jax.random.split(jax.random.key(0), 2))
    return Loaded(
        source=Path("run"),
        task=task,
        env=env,
        config=config,
        actor=Actor(policy_params=params, obs_statistics=None),
        training={"seed_indices": [0, 1]},
        levels={},
        command="",
    )


def test_a_film_is_the_episode_of_its_policy() -> None:
    """A fall ends it. The same episode is played by a loop over steps, with the policy in NumPy."""
    loaded = untrained("Hopper")
    shown = film.record(loaded, 1, seed=3, deterministic=True)
    env, policy = loaded.env, policies(loaded.config, loaded.actor, loaded.env)[1]
    state, step = jax.jit(env.reset)(jax.random.split(jax.random.key(3))[0]), jax.jit(env.step)
    while not state.done:
        state = step(state, policy.mode(np.asarray(state.obs)).astype(np.float32))
    length = int(state.step_count)
    assert 5 < length < 1000
    assert shown.steps.tolist() == sorted({*range(0, length, 5), length})  # 5 steps of 0.008 s are one frame
    np.testing.assert_allclose(shown.returns[-1], state.episode_return, rtol=1e-4)
    np.testing.assert_allclose(shown.costs[-1], state.episode_cost, rtol=1e-4)
    assert shown.paid.tolist() == (np.diff(shown.costs, prepend=0) > 0).tolist()
    places = shown.strokes.places
    assert places.shape == (len(shown.steps), 4, 4)
    lengths = np.hypot(*(places[:, :, 2:] - places[:, :, :2]).transpose(2, 0, 1))
    np.testing.assert_allclose(lengths, np.tile([0.4, 0.45, 0.5, 0.39], (len(lengths), 1)), atol=1e-6)  # hopper.xml
    np.testing.assert_allclose(places[0, 0, 3], 1.45, atol=0.02)  # it stands upright, its head that high


def test_an_arena_shows_robot_and_objects_where_they_are() -> None:
    loaded = untrained("PointGoal1", max_episode_steps=20)
    shown = film.record(loaded, 0, seed=1)
    kinds = [shape.kind for shape in shown.strokes.shapes]
    assert kinds == ["goal", *["hazards"] * 8, "vases", "robot", "robot"]
    start = jax.jit(loaded.env.reset)(jax.random.split(jax.random.key(1))[0])
    objects = loaded.env.situation(start.physics).objects
    for i, kind in enumerate(["goal", *["hazards"] * 8]):
        centre = objects[kind][max(0, i - 1)][:2]
        np.testing.assert_allclose(shown.strokes.places[0, i], [*centre, *centre], atol=1e-6)
        assert shown.strokes.shapes[i].width == pytest.approx(0.6 if kind == "goal" else 0.4)
    vase = shown.strokes.places[0, 9].reshape(2, 2)
    np.testing.assert_allclose(vase.mean(axis=0), objects["vases"][0, :2], atol=1e-6)
    np.testing.assert_allclose(np.hypot(*(vase[1] - vase[0])), 0.2, atol=1e-6)
    assert shown.way is not None
    np.testing.assert_allclose(shown.way[0], start.physics.data.qpos[:2], atol=1e-6)
    assert shown.steps[-1] == 20
    assert 1e-4 < np.abs(np.diff(shown.way, axis=0)).max() < 0.1  # it moves, and does not jump
    assert np.abs(shown.strokes.places).max() < shown.span / 2


def test_a_demonstration_is_shown_where_its_observations_say() -> None:
    """Bodies that gymnasium's own simulator moves; the place of the root is left out of its observations."""
    simulator = gymnasium.make("HalfCheetah-v5")
    obs, _ = simulator.reset(seed=0)
    inner, random, rows, torsos = simulator.unwrapped, np.random.default_rng(0), [], []
    for _ in range(30):
        action = random.uniform(-1, 1, 6)
        rows.append((obs, action))
        mujoco.mj_kinematics(inner.model, inner.data)  # after a step, places are those of the substep before
        torsos.append(inner.data.geom("torso").xpos[[0, 2]].copy())
        obs = simulator.step(action)[0]
    simulator.close()
    columns = [np.array(column, np.float32) for column in zip(*rows, strict=True)]
    found = Demonstrations(
        obs=columns[0],
        actions=columns[1],
        rewards=np.full(30, 0.5, np.float32),
        costs=(np.arange(30) == 4).astype(np.float32),
        terminated=np.zeros(30, bool),
        truncated=np.arange(30) == 29,
        episode_ends=np.array([30]),
    )
    env = envs.make("HalfCheetah", physics="native")
    shown = film.of_demonstration(env, found)
    assert shown is not None
    assert shown.steps.tolist() == list(range(31))
    torso = shown.strokes.places[:30, 0].reshape(30, 2, 2).mean(axis=1)
    expected = np.array(torsos) - torsos[0] * np.array([1, 0])
    np.testing.assert_allclose(torso[:, 1], expected[:, 1], atol=1e-4)
    np.testing.assert_allclose(torso[:, 0] - torso[0, 0], expected[:, 0], atol=0.03)
    assert np.ptp(expected[:, 0]) > 0.05
    np.testing.assert_allclose(shown.returns[[0, 10, 30]], [0.0, 5.0, 15.0])
    assert shown.costs[[4, 5, 30]].tolist() == [0, 1, 1]
    assert np.flatnonzero(shown.paid).tolist() == [5]
    assert film.of_demonstration(object(), found) is None


ROBOT = """
<mujoco>
  <option timestep="0.02" gravity="0 0 0"/>
  <asset><mesh name="bar" vertex="0 0 0  .5 0 0  0 .2 0  .5 .2 0  0 0 .3  .5 0 .3  0 .2 .3  .5 .2 .3"/></asset>
  <worldbody>
    <geom type="plane" size="9 9 1"/>
    <body pos="0 0 1">
      <freejoint/>
      <geom type="box" size=".1 .2 .5" euler="0 30 90"/>
      <geom type="cylinder" size=".3 .05" pos="1 0 -.7" euler="90 0 0"/>
      <geom type="ellipsoid" size=".2 .1 .4" pos="-1 0 0" euler="0 60 0"/>
      <body pos="1.2 .3 .4" euler="0 -20 0">
        <joint name="swing" axis="0 1 0"/>
        <geom type="capsule" size=".06" fromto="0 0 0 .4 0 .3"/>
        <geom type="mesh" mesh="bar" group="3"/>
      </body>
      <body pos="-1.2 0 .8" euler="0 40 0">
        <geom type="mesh" mesh="bar"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="swing" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Locomotion:
    """A robot of the user's own with shapes of all kinds. The mesh beside the capsule is not drawn."""
    path = tmp_path_factory.mktemp("robot") / "robot.xml"
    path.write_text(ROBOT, encoding="utf-8")
    row = LocomotionTask(
        xml=str(path), frame_skip=2, num_hidden=3, qvel_noise=0.5, cost_quantity=lambda x: x.velocity[0]
    )
    return Locomotion(row, name="Robot", physics="native", cost_threshold=0.1, max_episode_steps=10)


def seen_by_rays(env: Any, qpos: np.ndarray, shown: film.Film, index: int) -> np.ndarray:
    """[80, 160] bool: where a frame of a film should show a body, from rays along y that MuJoCo itself casts."""
    data = mujoco.MjData(env.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(env.model, data)
    pixel, groups, geom = shown.span / 80, np.array([1, 1, 1, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    hit = np.zeros((80, 160), bool)
    for i, j in np.ndindex(hit.shape):
        x, z = shown.centre[index] + pixel * np.array([j - 79.5, 39.5 - i])
        mujoco.mj_ray(env.model, data, np.array([x, -9.0, z]), np.array([0.0, 1.0, 0.0]), groups, 1, -1, geom)
        hit[i, j] = geom[0] > 0
    return hit


def test_a_robot_of_ones_own_is_drawn_as_mujoco_sees_it(robot: Locomotion) -> None:
    """Its silhouette in the first and the last frame; and the film of the same task under another cost counts that."""
    loaded = untrained_on(envs.with_cost(robot, lambda before, action, after: jnp.square(action).sum()))
    shown = film.record(loaded, 0, deterministic=True)
    policy = policies(loaded.config, loaded.actor, loaded.env)[0]
    start = state = jax.jit(loaded.env.reset)(jax.random.split(jax.random.key(0))[0])
    step = jax.jit(loaded.env.step)
    for _ in range(10):
        state = step(state, policy.mode(np.asarray(state.obs)).astype(np.float32))
    np.testing.assert_allclose(shown.costs[-1], state.episode_cost, rtol=1e-4)
    assert shown.costs[-1] > 0
    assert shown.steps.tolist() == list(range(11))
    for index, there in ((0, start), (10, state)):
        picture = np.asarray(video.draw(shown, index, ""))[64:].astype(int)
        drawn = [np.abs(picture - color).max(axis=-1) < 12 for color in ([0x0B, 0x6E, 0x99], [0xD1, 0x49, 0x5B])]
        drawn_there = (drawn[0] | drawn[1])[2::4, 2::4]
        seen = seen_by_rays(robot, np.asarray(there.physics.qpos), shown, index)
        assert seen.sum() > 500
        assert (drawn_there & seen).sum() > 0.9 * (drawn_there | seen).sum()


def test_what_is_fixed_is_drawn_behind_the_bodies_where_it_stands(robot: Locomotion, tmp_path: Path) -> None:
    """A rail and a wall of the world; the picture follows the bodies as it does without them."""
    path = tmp_path / "robot.xml"
    fixed = '<geom type="capsule" fromto="-3 0 1 5 0 1" size=".05"/><geom type="box" size=".1 1 .4" pos="7 0 .4"/>'
    path.write_text(ROBOT.replace("<worldbody>", f"<worldbody>{fixed}"), encoding="utf-8")
    railed = Locomotion(
        dataclasses.replace(robot.task, xml=str(path)), name="Railed", physics="native", cost_threshold=0.1
    )
    qpos = {"qpos": np.tile(robot.model.qpos0, (3, 1)) + np.array([[0.0], [0.1], [0.2]])}
    plain, shown = (film._make(env, qpos, {}, np.zeros(3), np.zeros(3)) for env in (robot, railed))
    assert [shape.kind for shape in shown.strokes.shapes[:3]] == ["scenery", "scenery", "body"]
    assert [shape.width for shape in shown.strokes.shapes[:2]] == pytest.approx([0.1, 0.2])
    rail, wall = (np.sort(shown.strokes.places[:, i].reshape(3, 2, 2), axis=1) for i in range(2))
    np.testing.assert_allclose(rail, np.tile([[-3, 1], [5, 1]], (3, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(wall, np.tile([[7, 0], [7, 0.8]], (3, 1, 1)), atol=1e-6)
    np.testing.assert_array_equal(shown.strokes.places[:, 2:], plain.strokes.places)
    np.testing.assert_array_equal(shown.centre, plain.centre)
    assert shown.span == plain.span


def test_where_the_physics_has_failed_the_last_frame_repeats_a_pose(robot: Locomotion) -> None:
    qpos = np.tile(robot.model.qpos0, (3, 1)) + np.array([[0.0], [0.1], [np.nan]])
    shown = film._make(robot, {"qpos": qpos}, {}, np.zeros(3), np.zeros(3))
    np.testing.assert_array_equal(shown.strokes.places[2], shown.strokes.places[1])
    assert np.isfinite(shown.strokes.places).all()


@pytest.mark.parametrize("task", TASKS)
def test_every_task_of_the_package_can_be_drawn(task: str) -> None:
    assert film.obstacle(envs.make(task, physics="native")) == ""


def test_what_cannot_be_drawn_has_a_reason(robot: Locomotion) -> None:
    def changed(**changes: Any) -> Any:
        return types.SimpleNamespace(
            **{"model": robot.model, "dt": 0.04, "view": "side", "engine_arrays": id} | changes
        )

    empty = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    assert film.obstacle(changed()) == ""
    assert film.obstacle(Walk()) == film.obstacle(changed(model=1)) == "it has no MuJoCo model"
    assert film.obstacle(types.SimpleNamespace(model=robot.model)).endswith(
        "attribute engine_arrays and no dt and no view"
    )
    assert (
        film.obstacle(changed(view="below")) == "its attribute view is 'below', and not one of 'side', 'above', 'arena'"
    )
    assert film.obstacle(changed(model=empty)) == "no body of its MuJoCo model has a shape to draw"


@pytest.mark.parametrize(
    ("joints", "count"),
    [
        ("<joint type='slide'/><joint/>", 2),
        ("<joint type='slide'/><joint type='ball'/>", 1),
        ("<freejoint/>", 3),
    ],
)
def test_a_place_is_summed_up_as_long_as_velocities_are_its_derivatives(joints: str, count: int) -> None:
    xml = f"<mujoco><worldbody><body>{joints}<geom size='1'/></body></worldbody></mujoco>"
    assert film._num_summable(mujoco.MjModel.from_xml_string(xml)) == count


@pytest.mark.parametrize(
    ("task", "change", "title", "sentence"),
    [
        ("Swimmer", None, "the expert, as demonstrated", "where its root is follows from the recorded velocities"),
        ("PointGoal1", None, None, "the observations in the demonstrations of PointGoal1 do not say where the robot"),
        ("PointGoal1", "file", None, "The expert is not shown: its demonstrations, gone.npz, are no longer where"),
        ("Swimmer", "sha256", None, "Swimmer.npz, have changed since, and no policy of an expert is shipped for Swim"),
        ("CarGoal1", None, "the shipped expert", "the expert's policy that is shipped for CarGoal1, in the same start"),
        ("Hopper", "sha256", "the shipped expert", "its demonstrations, Hopper.npz, have changed since"),
    ],
)
def test_the_expert_is_shown_where_it_is_at_hand(
    task: str, change: str | None, title: str | None, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no title is expected, no policy of the task's expert is shipped."""
    path = SHIPPED / f"{task}.npz"
    facts = {"file": str(path), "sha256": file_sha256(path)}
    if change:
        facts[change] = "gone.npz"
    if title is None:
        monkeypatch.setattr(policy_file, "shipped", lambda: tmp_path)
    played: list[Any] = []
    monkeypatch.setattr(film, "record", lambda loaded, index: played.append((loaded.source.name, index)))
    loaded = evaluating.dataclasses.replace(untrained("Swimmer"), task=TASKS[task], env=envs.make(task))
    films, note = episodes._expert(loaded, facts)
    assert [found for found, _ in films] == ([title] if title else [])
    assert sentence in note
    assert played == ([(f"{task}.npz", 0)] if title == "the shipped expert" else [])
