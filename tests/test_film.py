"""What films show: the engine's bodies and objects, and the episode's own return and cost."""

from pathlib import Path
from typing import Any

import gymnasium
import jax
import mujoco
import numpy as np
import pytest

import envs
from ccil_jax.acting import networks
from ccil_jax.acting.rollout import Actor
from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.training.filesystem import file_sha256
from envs.registry import TASKS
from experiments.page import episodes, film
from experiments.policies import evaluating, policy_file
from experiments.policies.evaluating import Loaded
from experiments.policies.numpy_policy import policies

SHIPPED = policy_file.shipped().parent / "demonstrations"


def untrained(task: str, **options: Any) -> Loaded:
    """An untrained policy with two seeds."""
    env, config = envs.make(task, physics="native", **options), Config(method="trpo", hidden_sizes=(8,))
    params = jax.vmap(networks.policy_of(config, env).init)(jax.random.split(jax.random.key(0), 2))
    return Loaded(
        source=Path("run"),
        task=TASKS[task],
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
    shown = film.of_demonstration(env, "side", found)
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
    assert film.of_demonstration(object(), "side", found) is None


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
