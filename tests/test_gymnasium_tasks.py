"""Our tasks under gymnasium's own names: what a user of gymnasium gets without any code of ours."""

import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import envs
from envs.registry import TASKS
from tests.probe_envs import Walk

QUICK = ("Swimmer", "Ant", "PointGoal1", "CarButton1", "DoggoGoal1")  # one of each kind; the others are like them


@pytest.mark.parametrize("task", [t if t in QUICK else pytest.param(t, marks=pytest.mark.slow) for t in TASKS])
def test_gymnasiums_checker_has_no_complaint(task: str) -> None:
    """Warnings are errors here, so it does not even warn."""
    env = gymnasium.make(f"ccil/{task}-v0", physics="native")
    assert env.spec is not None
    assert env.spec.max_episode_steps == 1000
    check_env(env.unwrapped)


def test_single_episodes_are_those_of_our_own_environment() -> None:
    """The wrapper `TimeLimit` cuts them off where ours does, and every step tells its cost."""
    env = gymnasium.make("ccil/Swimmer-v0", physics="native", max_episode_steps=3, cost_threshold=0.01)
    vector = gymnasium.make_vec("ccil/Swimmer-v0", 1, physics="native", max_episode_steps=3, cost_threshold=0.01)
    rng = np.random.default_rng(0)
    runs: list[dict[str, np.ndarray]] = []
    for _ in range(2):
        actions = rng.uniform(-1, 1, (6, 2)).astype(np.float32) if not runs else runs[0]["actions"]
        obs, _ = env.reset(seed=7)
        steps, starts = [], [obs]
        for action in actions:
            obs, reward, terminated, truncated, info = env.step(action)
            steps.append((*obs, reward, terminated, truncated, info["cost"]))
            if truncated:
                starts.append(env.reset()[0])
        runs.append({"actions": actions, "steps": np.array(steps), "starts": np.array(starts)})
    np.testing.assert_array_equal(runs[0]["steps"], runs[1]["steps"])
    np.testing.assert_array_equal(runs[0]["starts"], runs[1]["starts"])
    np.testing.assert_array_equal(runs[0]["steps"][:, -2], [0, 0, 1, 0, 0, 1])
    assert runs[0]["steps"][:, -1].any()
    assert not np.array_equal(runs[0]["starts"][0], runs[0]["starts"][1])
    assert not np.array_equal(env.reset(seed=8)[0], runs[0]["starts"][0])
    assert vector.observation_space.shape == (1, *env.observation_space.shape)  # type: ignore[misc]
    assert vector.single_observation_space == env.observation_space
    assert vector.single_action_space == env.action_space


def test_a_vector_environment_is_one_program() -> None:
    env: Any = gymnasium.make_vec("ccil/HalfCheetah-v0", num_envs=4, physics="native", max_episode_steps=2)
    assert isinstance(env, envs.GymnasiumVectorEnv)
    assert (env.num_envs, env.metadata["autoreset_mode"]) == (4, AutoresetMode.SAME_STEP)
    env.reset(seed=0)
    for expected in (False, True):
        _, _, _, truncated, info = env.step(np.zeros((4, 6), np.float32))
        assert truncated.tolist() == [expected] * 4
        assert info["cost"].shape == (4,)
    assert gymnasium.make_vec("ccil/HalfCheetah-v0", num_envs=4, physics="native").spec.kwargs["num_envs"] == 4  # type: ignore[union-attr]


def test_a_longer_limit_than_ours_is_kept_by_gymnasium() -> None:
    env = gymnasium.make("ccil/Swimmer-v0", physics="native", max_episode_steps=1200)
    env.reset(seed=0)
    ends = [env.step(np.zeros(2, np.float32))[3] for _ in range(1200)]
    assert ends.index(True) == 1199


def test_a_wrong_option_is_refused_as_by_make() -> None:
    with pytest.raises(ValueError, match="Swimmer has no option 'threshold'"):
        gymnasium.make("ccil/Swimmer-v0", threshold=1.0)
    with pytest.raises(ValueError, match="render_mode 'human': this environment cannot be drawn"):
        envs.GymnasiumEnv(Walk(), render_mode="human")
    with pytest.raises(ValueError, match="render_mode 'human': this environment cannot be drawn"):
        gymnasium.make_vec("ccil/Swimmer-v0", render_mode="human")


def test_step_before_reset_is_refused() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.GymnasiumEnv(Walk()).step(np.zeros(1, np.float32))


def test_an_action_of_another_shape_is_refused() -> None:
    env = envs.GymnasiumEnv(envs.make("Swimmer", physics="native"))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"Swimmer: an action must have shape \(2,\), but has shape \(1, 2\)"):
        env.step(np.zeros((1, 2), np.float32))


def make_walk(max_episode_steps: int = 7) -> Walk:
    return Walk(max_episode_steps=max_episode_steps)


def test_registered_tasks_are_entered_on_demand() -> None:
    envs.register("WalkForGymnasium", make_walk)
    try:
        assert "ccil/WalkForGymnasium-v0" not in gymnasium.registry
        envs.register_with_gymnasium()
        before = dict(gymnasium.registry)
        envs.register_with_gymnasium()  # again, without a warning
        assert gymnasium.registry == before
        env = gymnasium.make("ccil/WalkForGymnasium-v0")
        env.reset(seed=0)
        assert env.spec is not None
        assert env.spec.max_episode_steps == 7
    finally:
        envs.registry._tasks.pop("WalkForGymnasium")
        gymnasium.registry.pop("ccil/WalkForGymnasium-v0", None)


ORDERS = ("import envs, gymnasium", "import gymnasium, envs", "import envs, gymnasium.vector")


@pytest.mark.parametrize("order", ORDERS)
def test_importing_both_in_either_order_is_enough(order: str) -> None:
    program = f"""
import sys
{order.partition(",")[0]}
jax_free = "jax" not in sys.modules
{order}
names = [f"ccil/{{task}}-v0" for task in envs.TASKS]
assert jax_free and "jax" not in sys.modules
assert all(name in gymnasium.registry for name in names) and len(names) == 14
assert not any(type(finder).__name__ == "_AfterGymnasium" for finder in sys.meta_path)
"""
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)


def test_looking_for_gymnasium_does_not_end_the_watch() -> None:
    """As the model files are looked for before anyone imports gymnasium itself."""
    program = """
import importlib.util, sys, envs
importlib.util.find_spec("gymnasium")
assert "gymnasium" not in sys.modules
import gymnasium
assert "ccil/Swimmer-v0" in gymnasium.registry
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_a_spec_that_somebody_has_kept_can_be_executed_as_well() -> None:
    program = """
import importlib.util, envs
kept = importlib.util.find_spec("gymnasium")
import gymnasium
kept.loader.exec_module(importlib.util.module_from_spec(kept))
assert "ccil/Ant-v0" in gymnasium.registry
"""
    subprocess.run([sys.executable, "-c", program], check=True)
