"""What every task owes its learner, whatever its family."""

from typing import Any

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
