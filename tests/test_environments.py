"""What every task owes its learner, whatever its family."""

from typing import Any

import jax
import mujoco
import numpy as np
import pytest

import envs
from envs.testing import check_environment


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
