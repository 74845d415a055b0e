"""Our tasks against gymnasium's `-v5`: one control step from many states, and whole trajectories."""

import functools
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
import scipy.stats

import envs

pytestmark = pytest.mark.once

pytest.importorskip("imageio", reason="gymnasium's MuJoCo tasks import it")
gymnasium = pytest.importorskip("gymnasium")

NUM_STATES = 200
LOCOMOTION = [name for name, info in envs.TASKS.items() if info.family == "locomotion"]
TERMS = {
    "forward": "reward_forward",
    "healthy": "reward_survive",
    "control": "reward_ctrl",
    "contact": "reward_contact",
}
# Native runs gymnasium's own engine on the same float64 state: only conversions to float32 round.
NATIVE: Any = {"rtol": 1e-5, "atol": 1e-6}


def make_original(name: str) -> Any:
    task = envs.TASKS[name]
    mujoco.set_mju_user_warning(lambda _: None)  # a model's deprecated attribute would go to a log file here
    try:
        return gymnasium.make(task.original, **task.original_options).unwrapped
    finally:
        mujoco.set_mju_user_warning(None)


def put(original: Any, qpos: np.ndarray, qvel: np.ndarray) -> None:
    """A fresh simulation at a state, as ours starts one: no warm start, time 0."""
    original.reset()
    original.set_state(qpos.astype(np.float64), qvel.astype(np.float64))
    original.data.qacc_warmstart[:] = 0.0


@functools.cache
def reference(name: str) -> dict[str, Any]:
    """Steps of the original from float32 states met on random episodes (contacts included)."""
    original, rng = make_original(name), np.random.default_rng(0)
    states: list[tuple[np.ndarray, np.ndarray]] = []
    original_steps: list[Any] = []
    original.reset(seed=0)
    while len(states) < NUM_STATES:
        states.append((original.data.qpos.astype(np.float32), original.data.qvel.astype(np.float32)))
        # Four steps between kept states; episodes go on while healthy, so that falls are among the states.
        for _ in range(4):
            action = rng.uniform(original.action_space.low, original.action_space.high)
            if original.step(action)[2]:
                original.reset()
                break
    low, high = original.action_space.low, original.action_space.high
    actions = rng.uniform(low, high, (NUM_STATES, len(low))).astype(np.float32)
    contacts = 0
    for (qpos, qvel), action in zip(states, actions, strict=True):
        put(original, qpos, qvel)
        obs, reward, terminated, _, info = original.step(action)
        contacts += original.data.ncon > 0
        original_steps.append((obs, reward, terminated, info))
    if name != "Swimmer":
        assert contacts > NUM_STATES // 10
    return {
        "qpos": np.stack([qpos for qpos, _ in states]),
        "qvel": np.stack([qvel for _, qvel in states]),
        "actions": actions,
        "obs": np.stack([obs for obs, *_ in original_steps]),
        "rewards": np.array([reward for _, reward, *_ in original_steps]),
        "terminated": np.array([terminated for *_, terminated, _ in original_steps]),
        "infos": [info for *_, info in original_steps],
        "dt": original.dt,
    }


def one_step(env: Any, expected: dict[str, Any]) -> Any:
    def step(qpos: jax.Array, qvel: jax.Array, action: jax.Array) -> Any:
        return env.step(env.reset_to(qpos, qvel), action)

    return jax.jit(jax.vmap(step))(expected["qpos"], expected["qvel"], expected["actions"])


def independent_cost(name: str, info: dict[str, float], action: np.ndarray) -> float:
    """The quantity behind the 0/1 cost, from gymnasium's own report."""
    match name:
        case "Swimmer":
            return float(np.hypot(info["x_velocity"], info["y_velocity"]))
        case "Walker2d":
            return abs(info["x_velocity"])
        case "HalfCheetah":
            return abs(info["reward_ctrl"])
        case "Hopper":
            return float(np.sum(action.astype(np.float64) ** 2))
        case _:
            return abs(info["reward_ctrl"]) + abs(info["reward_contact"])


def independent_reward(name: str, info: dict[str, float]) -> float:
    """The authors' reward, from gymnasium's own report."""
    if name in ("Swimmer", "Walker2d"):
        return info["reward_forward"] + info["reward_ctrl"] + info.get("reward_survive", 0.0)
    return info["reward_forward"] + info.get("reward_survive", 0.0)


@pytest.mark.parametrize("name", LOCOMOTION)
def test_starts_are_distributed_as_gymnasiums(name: str) -> None:
    """Kolmogorov-Smirnov, each coordinate by itself: the smallest p of n must be as of n uniform ones."""
    original, env = make_original(name), envs.make(name, physics="native")
    theirs = []
    for seed in range(300):
        original.reset(seed=seed)
        theirs.append(np.concatenate([original.data.qpos, original.data.qvel]))
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(4), 300)).physics
    ours = np.concatenate([starts.qpos, starts.qvel], axis=1)
    p_values = [scipy.stats.ks_2samp(a, b).pvalue for a, b in zip(ours.T, np.array(theirs).T, strict=True)]
    assert min(p_values) > 1e-3 / len(p_values)


@pytest.mark.parametrize("name", LOCOMOTION)
def test_native_step_equals_gymnasium(name: str) -> None:
    expected = reference(name)
    env: Any = envs.make(name, physics="native")
    state = one_step(env, expected)
    assert env.dt == pytest.approx(expected["dt"])
    np.testing.assert_allclose(state.obs, expected["obs"], **NATIVE)
    infos = expected["infos"]
    for term, key in TERMS.items():
        wanted = np.array([info.get(key, 0.0) for info in infos])
        np.testing.assert_allclose(state.terms[term], wanted, **NATIVE, err_msg=term)
    rewards = np.array([independent_reward(name, info) for info in infos])
    np.testing.assert_allclose(state.reward, rewards, **NATIVE)
    np.testing.assert_array_equal(state.terminated, expected["terminated"])
    assert not state.truncated.any()
    quantity = np.array([independent_cost(name, i, a) for i, a in zip(infos, expected["actions"], strict=True)])
    np.testing.assert_array_equal(state.cost, quantity > env.cost_threshold)
    assert 0 < state.cost.mean() < 1


@pytest.mark.parametrize("name", LOCOMOTION)
def test_a_task_says_what_its_reward_lacks_of_gymnasiums(name: str) -> None:
    expected, lacks = reference(name), envs.TASKS[name].reward_lacks
    ours = np.array([independent_reward(name, info) for info in expected["infos"]])
    left_out = [TERMS[term] for term in ("control", "contact") if term in lacks]
    terms = sum(np.array([info[key] for info in expected["infos"]]) for key in left_out)
    np.testing.assert_allclose(expected["rewards"], ours + terms, rtol=1e-9, atol=1e-9)
    assert bool(lacks) == (not np.allclose(expected["rewards"], ours))


@pytest.mark.parametrize("name", LOCOMOTION)
def test_native_trajectory_is_gymnasiums_to_the_last_bit(name: str) -> None:
    """200 steps in lockstep: the float64 state, warm start included, is carried without loss."""
    original: Any = make_original(name)
    env: Any = envs.make(name, physics="native")
    rng = np.random.default_rng(1)
    original.reset(seed=1)
    qpos, qvel = original.data.qpos.astype(np.float32), original.data.qvel.astype(np.float32)
    put(original, qpos, qvel)
    state, step = jax.jit(env.reset_to)(qpos, qvel), jax.jit(env.step)
    nq, nv = len(qpos), len(qvel)
    for _ in range(200):
        action = rng.uniform(original.action_space.low, original.action_space.high).astype(np.float32)
        _, _, _, _, info = original.step(action)
        state = step(state, action)
        row = np.asarray(state.physics.backend).view(np.float64)
        np.testing.assert_array_equal(row[1 : 1 + nq], original.data.qpos)
        np.testing.assert_array_equal(row[1 + nq : 1 + nq + nv], original.data.qvel)
        np.testing.assert_allclose(state.terms["forward"], info["reward_forward"], **NATIVE)
    assert int(state.step_count) == 200


QUICK = {("HalfCheetah", "mjx"), ("Ant", "warp")}  # to compile; Ant has contact forces and legs of all directions


@pytest.mark.parametrize(
    ("name", "physics"),
    [
        pytest.param(name, physics, marks=() if (name, physics) in QUICK else pytest.mark.slow)
        for name in LOCOMOTION
        for physics in ("mjx", "warp")
    ],
)
def test_step_on_an_accelerators_engine_equals_gymnasium(
    name: str, physics: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """1e-3 in float32, contacts included; the velocities of Ant's feet set it (8e-4 worst), the median is below 1e-5.

    Looser than native because the solver iterates in float32; in float64 the same comparison gives 1e-13 on mjx.
    """
    expected = reference(name)
    env: Any = envs.make(name, physics=physics)
    state = one_step(env, expected)
    assert "Module" not in capfd.readouterr().out  # Warp's own lines
    error = np.abs(state.obs - expected["obs"]) / np.maximum(1.0, np.abs(expected["obs"]))
    assert error.max() < 1e-3
    assert np.median(error.max(axis=1)) < 1e-5
    infos = expected["infos"]
    for term, key in TERMS.items():
        wanted = np.array([info.get(key, 0.0) for info in infos])
        np.testing.assert_allclose(state.terms[term], wanted, rtol=1e-4, atol=1e-4, err_msg=term)
    np.testing.assert_array_equal(state.terminated, expected["terminated"])
    quantity = np.array([independent_cost(name, i, a) for i, a in zip(infos, expected["actions"], strict=True)])
    clear = np.abs(quantity - env.cost_threshold) > 1e-4
    np.testing.assert_array_equal(np.asarray(state.cost)[clear], (quantity > env.cost_threshold)[clear])


@pytest.mark.slow
def test_mjx_ant_equals_c_in_float64() -> None:
    """With the corrected plane-capsule frame; without it the worst error is above 1 (see `physics/mjx_patch.py`)."""
    expected = reference("Ant")
    with jax.enable_x64(True):
        state = one_step(envs.make("Ant", physics="mjx"), expected)
    assert state.obs.dtype == np.float64
    np.testing.assert_allclose(state.obs, expected["obs"], rtol=1e-7, atol=1e-7)
