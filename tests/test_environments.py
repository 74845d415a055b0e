"""What every task owes its learner, whatever its family."""

from typing import Any

import jax
import mujoco
import numpy as np
import pytest

import envs
from envs.testing import check_environment

pytestmark = pytest.mark.once

LOCOMOTION = [name for name, info in envs.TASKS.items() if info.family == "locomotion"]


@pytest.fixture(scope="module", params=envs.TASKS)
def env(request: pytest.FixtureRequest) -> Any:
    return envs.make(request.param, physics="native")


def test_environment_contract(env: Any) -> None:
    check_environment(env)


def test_sizes_are_the_registrys(env: Any) -> None:
    info = envs.TASKS[env.name]
    assert (env.obs_dim, env.action_dim) == (info.obs_dim, info.action_dim) == (env.obs_dim, env.model.nu)
    assert env.action_low.shape == env.action_high.shape == (env.action_dim,)
    assert env.physics_name == "native"
    assert env.max_episode_steps == 1000


@pytest.mark.parametrize("shape", [(), (1,), (1, 1), "one more", "a batch"])
def test_an_action_of_another_shape_is_refused(env: Any, shape: Any) -> None:
    shape = {"one more": (env.action_dim + 1,), "a batch": (1, env.action_dim)}.get(shape, shape)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    if shape == (env.action_dim,):
        pytest.skip("the right shape of a task with one action")
    with pytest.raises(ValueError, match=env.name) as error:
        jax.eval_shape(env.step, state, jax.ShapeDtypeStruct(shape, np.float32))
    assert f"must have shape ({env.action_dim},), but has shape {shape}" in str(error.value)


def test_a_position_of_another_shape_is_refused(env: Any) -> None:
    layout = () if env.name in LOCOMOTION else (np.zeros((len(getattr(env, "_radii", ())), 2)),)
    for qpos, qvel in ((0.0, np.zeros(env.model.nv)), (np.zeros(env.model.nq), np.zeros(1 + env.model.nv))):
        with pytest.raises(ValueError, match=rf"{env.name}: q(pos|vel) must have shape"):
            env.reset_to(*layout, qpos, qvel)


def test_the_engine_steps_on_from_a_states_arrays(env: Any) -> None:
    state, data = jax.jit(env.reset)(jax.random.key(1)), mujoco.MjData(env.model)
    arrays = jax.jit(env.engine_arrays)(state)
    for name, values in arrays.items():
        getattr(data, name)[:] = values
    data.ctrl[:] = action = np.full(env.action_dim, 0.3, np.float32)
    mujoco.mj_step(env.model, data, env.num_substeps)
    after = env.engine_arrays(jax.jit(env.step)(state, action))
    np.testing.assert_allclose(after["qpos"][:3], data.qpos[:3], atol=1e-5)  # the robot's
    if "mocap_pos" not in arrays:  # whose bodies move within a step
        np.testing.assert_allclose(after["qpos"], data.qpos, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("swimmer", "Swimmer"),
        ("Swimmer-v5", "Swimmer"),
        ("Humanoid-v4", "Humanoid"),
        ("SafetyPointGoal1-v0", "PointGoal1"),
        ("safetycarbutton1", "CarButton1"),
        ("Cheetah", "HalfCheetah"),
    ],
)
def test_the_task_that_was_meant_is_named(name: str, meant: str) -> None:
    with pytest.raises(
        ValueError,
        match=f"{name}: unknown task; did you mean {meant}\\? choose one of Swimmer, .*, or module:function for",
    ):
        envs.make(name)


def test_nothing_is_guessed_where_nothing_is_near() -> None:
    for name in (None, "zzz", 5):
        with pytest.raises(ValueError, match="unknown task; choose one of"):
            envs.make(name)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("PointGoal1", {"cost_threshold": 3}, "no option 'cost_threshold'.* options are physics, max_episode_steps, n"),
        ("Swimmer", {"max_episode_step": 3}, "did you mean max_episode_steps"),
        *(("Swimmer", {"max_episode_steps": value}, "whole number") for value in (0, -1, 1.5, True, "5", 2**31)),
        *(("Swimmer", {"num_threads": value}, "num_threads .*whole number") for value in (0, 1.5)),
        *(("Swimmer", {"cost_threshold": value}, "cost_threshold .*finite") for value in (-1, float("nan"), "1", [1])),
        ("Ant", {"contact_cost": "no"}, "True or False"),
        ("Swimmer", {"contact_cost": False}, "Swimmer has no option 'contact_cost'"),  # its cost counts no contacts
        ("Ant", {"physics": ["native"]}, "unknown physics"),
    ],
)
def test_options_and_values_that_a_task_cannot_have_are_refused(
    name: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as error:
        envs.make(name, **options)
    assert "\n" not in str(error.value)


def test_whole_numbers_of_numpy_are_options_too() -> None:
    env = envs.make("Swimmer", physics="native", max_episode_steps=np.int64(3), cost_threshold=np.float32(2))  # type: ignore[arg-type]
    assert (env.max_episode_steps, env.cost_threshold) == (3, 2.0)  # type: ignore[attr-defined]
