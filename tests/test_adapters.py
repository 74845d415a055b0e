"""Our tasks through gymnasium's and Brax's interfaces, and Brax's through ours."""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import envs
from envs.adapters import FromBrax, GymnasiumVectorEnv, to_brax
from envs.testing import check_environment

NUM_ENVS = 3
NUM_STEPS = 5


@pytest.fixture
def vector_env() -> GymnasiumVectorEnv:
    return GymnasiumVectorEnv(envs.make("HalfCheetah", physics="native", max_episode_steps=NUM_STEPS), NUM_ENVS)


class First(gymnasium.Env):
    """The first copy alone, so that gymnasium's checker of single environments can judge it."""

    def __init__(self, env: GymnasiumVectorEnv):
        self.env = env
        self.observation_space, self.action_space = env.single_observation_space, env.single_action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        obs, info = self.env.reset(seed=seed, options=options)
        return obs[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(np.tile(action, (NUM_ENVS, 1)))
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), {"cost": info["cost"][0]}


@pytest.mark.filterwarnings("ignore:.*infinity:UserWarning", "ignore:.*not within the expected.*:UserWarning")
def test_gymnasium_checker_accepts_it(vector_env: GymnasiumVectorEnv) -> None:
    check_env(First(vector_env), skip_render_check=True)


def test_vector_env_resets_in_the_step_that_ends_an_episode(vector_env: GymnasiumVectorEnv) -> None:
    assert vector_env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    first, _ = vector_env.reset(seed=0)
    assert vector_env.observation_space.contains(first)
    vector_env.action_space.seed(0)
    for t in range(2 * NUM_STEPS):
        obs, reward, terminated, truncated, info = vector_env.step(vector_env.action_space.sample())
        assert vector_env.observation_space.contains(obs)
        assert reward.shape == (NUM_ENVS,)
        assert set(np.unique(info["cost"])) <= {0.0, 1.0}
        assert not terminated.any()
        ended = (t + 1) % NUM_STEPS == 0
        assert truncated.all() == truncated.any() == ended == ("final_obs" in info)
        if ended:
            assert info["_final_obs"].all()
            assert np.abs(info["final_obs"][0] - obs[0]).max() > 0.1
            assert np.abs(obs[:, :8]).max() <= 0.1001, "positions of a fresh episode"
            assert (info["final_info"]["episode_cost"] >= info["final_info"]["cost"]).all()
    again, _ = vector_env.reset(seed=0)
    np.testing.assert_array_equal(first, again)


def test_gymnasium_wrappers_count_episodes(vector_env: GymnasiumVectorEnv) -> None:
    env = RecordEpisodeStatistics(vector_env)
    env.reset(seed=0)
    for _ in range(NUM_STEPS):
        *_, info = env.step(np.zeros((NUM_ENVS, 6), np.float32))
    np.testing.assert_array_equal(info["episode"]["l"], NUM_STEPS)
    np.testing.assert_allclose(info["episode"]["r"], info["final_info"]["episode_return"], rtol=1e-4, atol=1e-5)


def test_step_before_reset_is_refused(vector_env: GymnasiumVectorEnv) -> None:
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector_env.step(np.zeros((NUM_ENVS, 6), np.float32))


@pytest.mark.filterwarnings("ignore")  # Brax's own deprecations
def test_to_brax_in_braxs_training_wrappers() -> None:
    brax_envs = pytest.importorskip("brax.envs")
    from brax.envs.wrappers import training

    ours = envs.make("Humanoid", physics="native")  # its actions reach to 0.4 only
    env = to_brax(ours)
    assert isinstance(env, brax_envs.Env)
    assert (env.observation_size, env.action_size, env.backend) == (270, 17, "native")
    wrapped = training.wrap(env, episode_length=4)
    keys = jax.random.split(jax.random.PRNGKey(0), NUM_ENVS)  # Brax's wrappers take their shapes from raw keys
    state = jax.jit(wrapped.reset)(keys)
    start, step = state, jax.jit(wrapped.step)
    for t in range(4):
        state = step(state, jnp.ones((NUM_ENVS, 17)))
        np.testing.assert_allclose(state.metrics["control"], -0.1 * 17 * 0.4**2, rtol=1e-5)
        assert (np.asarray(state.done) == (t == 3)).all()
    np.testing.assert_array_equal(state.obs, start.obs)  # Brax's auto-reset goes back to the first state
    assert (np.asarray(state.info["truncation"]) == 1.0).all()
    assert set(np.unique(state.info["cost"])) <= {0.0, 1.0}


@pytest.mark.filterwarnings("ignore")
def test_from_brax_keeps_the_contract() -> None:
    brax_envs = pytest.importorskip("brax.envs")
    original = brax_envs.get_environment("fast")  # Brax's own stub for tests
    env = FromBrax(original, lambda before, action, after: jnp.square(action).sum(), name="fast", max_episode_steps=2)
    assert (env.obs_dim, env.action_dim) == (original.observation_size, original.action_size)
    state = env.reset(jax.random.key(0))
    for expected in (False, True):
        state = env.step(state, jnp.full(env.action_dim, 3.0))
        assert bool(state.truncated) == expected
        assert state.cost == env.action_dim
    assert state.episode_cost == 2 * env.action_dim


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Brax's own deprecations
def test_from_brax_ant_passes_the_environment_check() -> None:
    brax_envs = pytest.importorskip("brax.envs")
    original = brax_envs.get_environment("ant", backend="spring")
    check_environment(FromBrax(original, lambda before, action, after: jnp.abs(after.obs[0]), name="ant"))
