"""Safety Gym: the contract, layouts, goals, buttons, gremlins and lidar, on the native backend. Parity is elsewhere."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.distance import pdist

import envs
from envs.base import State
from envs.safety_gym import layout
from envs.safety_gym.environment import BUTTON_PAUSE, CIRCLE, SafetyGym
from envs.safety_gym.lidar import lidar
from envs.safety_gym.tasks import ARENA, TABLE

pytestmark = pytest.mark.once

RECORDED_LAYOUTS = Path(__file__).parent / "golden" / "safety_gym" / "layouts.npz"


# Layouts -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["PointGoal1", "PointButton1", "PointPush1"])
def task_name(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


def sampled(name: str, count: int, seed: int = 0) -> np.ndarray:
    sample = jax.jit(jax.vmap(lambda key: layout.sample(TABLE[name], key)))
    keys = jax.random.split(jax.random.key(seed), count)
    return np.concatenate([np.asarray(sample(part)) for part in np.split(keys, max(1, count // 5000))])


def test_no_two_objects_of_100000_layouts_are_too_near(task_name: str) -> None:
    task, radii = TABLE[task_name], layout.keepouts(TABLE[task_name])
    found = sampled(task_name, 100_000)
    first, second = np.triu_indices(len(radii), 1)
    distances = np.linalg.norm(found[:, first] - found[:, second], axis=-1)
    assert (distances.min(axis=0) >= radii[first] + radii[second] - 1e-6).all()
    assert (np.abs(found).max(axis=(0, 2)) <= ARENA - radii + 1e-6).all()
    assert len(layout.places_of(task)) == 1 + len(task.objects)


def test_distances_are_distributed_as_in_the_original(task_name: str) -> None:
    """Kolmogorov-Smirnov, each pair of objects by itself: the smallest p of n must be as of n uniform ones."""
    with np.load(RECORDED_LAYOUTS, allow_pickle=False) as file:
        theirs = file[task_name.removeprefix("Point")]
    found = sampled(task_name, 4000, seed=1)
    pairs = [np.array([pdist(one) for one in layouts]) for layouts in (found, theirs)]
    p_values = [scipy.stats.ks_2samp(a, b).pvalue for a, b in zip(pairs[0].T, pairs[1].T, strict=True)]
    assert min(p_values) > 1e-3 / len(p_values)
    for axis in range(2):
        p_values = [scipy.stats.ks_2samp(found[:, i, axis], theirs[:, i, axis]).pvalue for i in range(found.shape[1])]
        assert min(p_values) > 1e-3 / len(p_values)


def test_an_attempt_takes_the_first_clear_candidate() -> None:
    """Against the original's own way, object after object, in plain Python."""
    radii = np.array([0.4, 0.3, 0.3, 0.2])
    key = jax.random.key(3)
    placed, complete = layout.attempt(key, radii)
    expected: list[np.ndarray] = []
    for radius, points in zip(radii, np.asarray(layout.candidates(key, radii, layout.NUM_CANDIDATES)), strict=True):
        for point in points:
            if all(np.linalg.norm(point - p) >= radius + r for p, r in zip(expected, radii, strict=False)):
                expected.append(point)
                break
    assert complete
    np.testing.assert_array_equal(placed, expected)


def test_a_layout_without_room_is_reported() -> None:
    _, complete = layout.attempt(jax.random.key(0), [1.4, 1.4])
    assert not complete


def test_a_new_goal_is_clear_and_the_old_one_kept_where_there_is_no_room() -> None:
    others, old = jnp.array([[0.0, 0.0]]), jnp.array([9.0, 9.0])
    draw = jax.vmap(lambda key: layout.draw_goal(key, old, 0.3, others, np.array([0.8])))
    goals = np.asarray(draw(jax.random.split(jax.random.key(0), 200)))
    assert (np.linalg.norm(goals, axis=1) >= 1.1 - 1e-6).all()
    assert len(np.unique(goals[:, 0])) == 200
    np.testing.assert_array_equal(layout.draw_goal(jax.random.key(0), old, 0.3, others, np.array([5.0])), old)


# Rules ---------------------------------------------------------------------------------------------------------------


def start(env: SafetyGym, places: dict[str, Any], **changes: Any) -> State:
    """An episode with everything at its rest pose, objects far away (in a row) except those given."""
    rows = layout.places_of(env.task)
    where = np.stack([np.linspace(20.0, 40.0, len(layout.keepouts(env.task))), np.full(len(env._radii), 20.0)], axis=1)
    where[0] = 0.0
    for name, at in places.items():
        where[rows[name]] = at
    qpos, _ = env._initial_poses(jnp.asarray(where), jnp.zeros(len(where)))
    return env.reset_to(where, qpos, jnp.zeros(env.model.nv), **changes)


@pytest.fixture(scope="module")
def goal_env() -> SafetyGym:
    return SafetyGym("PointGoal1", physics="native")


@pytest.fixture(scope="module")
def button_env() -> SafetyGym:
    return SafetyGym("PointButton1", physics="native")


def still(env: SafetyGym, state: State) -> State:
    return jax.jit(env.step)(state, jnp.zeros(env.action_dim))


def test_reset_to_needs_a_layout_and_the_engines_state_only(button_env: SafetyGym) -> None:
    drawn = button_env.reset(jax.random.key(3)).physics
    state = button_env.reset_to(drawn.layout, drawn.data.qpos, drawn.data.qvel, goal_button=2)
    situation = button_env.situation(state.physics)
    np.testing.assert_array_equal(situation.goal[:2], situation.objects["buttons"][2, :2])
    np.testing.assert_array_equal(situation.robot, button_env.situation(drawn).robot)
    again = button_env.reset_to(
        drawn.layout, drawn.data.qpos, drawn.data.qvel, mocap_quat=drawn.mocap_quat, goal_button=drawn.goal_button
    )
    np.testing.assert_array_equal(again.obs, button_env.observe(drawn))


@pytest.mark.parametrize(("distance", "cost"), [(0.19, 1.0), (0.21, 0.0)])
def test_a_hazard_costs_while_the_robot_is_over_it(goal_env: SafetyGym, distance: float, cost: float) -> None:
    state = start(goal_env, {"hazards": [[distance, 0.0]] + [[9.0, 9.0]] * 7})
    after = still(goal_env, state)
    assert after.cost == after.terms["cost_hazards"] == after.episode_cost == cost


def test_reaching_the_goal_pays_and_moves_it(goal_env: SafetyGym) -> None:
    state = start(goal_env, {"goal": [[0.25, 0.0]]})
    after = still(goal_env, state)
    np.testing.assert_allclose(after.reward, 1.0, atol=1e-5)
    assert after.terms["bonus"] == 1
    goal = after.physics.layout[layout.places_of(goal_env.task)["goal"]]
    assert np.linalg.norm(goal) > 0.6
    assert not after.done
    # Progress counts from the new goal on: no jump in the next reward.
    assert abs(still(goal_env, after).reward) < 0.1


def test_the_reward_is_the_way_made_towards_the_goal(goal_env: SafetyGym) -> None:
    state, step = start(goal_env, {"goal": [[1.0, 0.0]]}), jax.jit(goal_env.step)
    for _ in range(20):
        state = step(state, jnp.array([1.0, 0.0]))
    travelled = float(state.physics.data.qpos[0])
    assert travelled > 0.05
    np.testing.assert_allclose(state.episode_return, travelled, rtol=1e-4)


def test_buttons_pause_after_a_right_press(button_env: SafetyGym) -> None:
    """The robot leans on two buttons: the right one first pays, then the wrong ones are free for a while."""
    buttons = [[0.0, 0.19], [0.0, -0.19], [9.0, 9.0], [9.0, -9.0]]
    state = start(button_env, {"buttons": buttons, "goal": [buttons[0]]}, goal_button=0)
    step = jax.jit(button_env.step)
    rewards, costs, seen = [], [], []
    for _ in range(BUTTON_PAUSE + 2):
        state = step(state, jnp.zeros(2))
        rewards.append(float(state.terms["bonus"]))
        costs.append(float(state.terms["cost_buttons"]))
        seen.append(bool(state.obs[12:28].any()))
    assert rewards[0] == 1
    assert costs[0] == 1  # the pause begins after this step
    quiet = 1 + BUTTON_PAUSE if 1 not in rewards[1:] else 1 + rewards[1:].index(1)
    assert not any(costs[1:quiet])
    assert not any(seen[: quiet - 1])


def test_gremlins_circle_on_their_course(button_env: SafetyGym) -> None:
    places = [[3.0, 0.0], [-3.0, 0.0], [0.0, 3.0], [0.0, -3.0]]
    state, step = start(button_env, {"gremlins": places}), jax.jit(button_env.step)
    for _ in range(150):
        state = step(state, jnp.zeros(2))
    time = float(state.physics.ticks) * button_env.model.opt.timestep
    course = CIRCLE * np.array([np.sin(time), np.cos(time)])
    centres = np.asarray(button_env._centres(state.physics, "gremlins"))
    np.testing.assert_allclose(centres[:, :2], np.array(places) + course, atol=0.05)  # the weld lags by some 0.09 s


def test_the_push_box_is_pushed() -> None:
    env: Any = envs.make("PointPush1", physics="native")
    state, step = start(env, {"push_box": [[0.45, 0.0]], "goal": [[2.0, 0.0]]}), jax.jit(env.step)
    for _ in range(60):
        state = step(state, jnp.array([1.0, 0.0]))
    assert env._centres(state.physics, "push_box")[0, 0] > 0.6
    assert state.terms["goal_distance"] > 0


# Lidar ---------------------------------------------------------------------------------------------------------------


def test_lidar_shows_an_object_in_its_bin_and_its_neighbours() -> None:
    angle, distance = 2.25 * 2 * np.pi / 16, 1.5
    point = distance * jnp.array([[np.cos(angle), np.sin(angle)]])
    found = lidar(jnp.zeros(3), jnp.eye(3), point)
    expected = np.zeros(16)
    expected[2], expected[3], expected[1] = 0.5, 0.125, 0.375
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_lidar_turns_with_the_robot_and_sees_3_metres() -> None:
    quarter = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # the robot looks along y
    ahead = lidar(jnp.zeros(3), quarter, jnp.array([[0.1, 1.0]]))
    assert jnp.argmax(ahead) in (15, 0)
    assert not lidar(jnp.zeros(3), jnp.eye(3), jnp.array([[3.01, 0.0]])).any()
    nearest = lidar(jnp.zeros(3), jnp.eye(3), jnp.array([[2.0, 0.1], [1.0, 0.05]]))
    np.testing.assert_allclose(nearest.max(), 1 - np.hypot(1, 0.05) / 3, rtol=1e-5)


def test_lidar_exactly_ahead_wraps() -> None:
    """An angle of just below zero rounds to 2 pi: safety-gymnasium 1.0.0 raises an IndexError there."""
    found = lidar(jnp.zeros(3), jnp.eye(3), jnp.array([[1.0, -1e-12]]))
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[0], 2 / 3, rtol=1e-6)
