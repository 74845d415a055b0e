"""Our tasks through gymnasium's and Brax's interfaces, and Brax's through ours."""

import dataclasses
from typing import Any, NamedTuple

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
from tests.probe_envs import Walk

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


@pytest.mark.parametrize("shape", [(), (6,), (NUM_ENVS,), (NUM_ENVS, 1), (1, 6), (NUM_ENVS, 5)])
def test_actions_of_another_shape_are_refused(vector_env: GymnasiumVectorEnv, shape: tuple[int, ...]) -> None:
    vector_env.reset(seed=0)
    with pytest.raises(ValueError, match=r"HalfCheetah: the actions must have shape \(3, 6\), but has"):
        vector_env.step(np.zeros(shape, np.float32))


@pytest.mark.parametrize("num_envs", [0, 1.5])
def test_a_number_of_copies_that_is_none_is_refused(num_envs: Any) -> None:
    with pytest.raises(ValueError, match=r"num_envs .*whole number"):
        GymnasiumVectorEnv(None, num_envs)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OfUnequalLength(Walk):
    """`Walk` from a place that is seen again only in an episode of its own."""

    max_episode_steps: int = 20


def test_each_copy_goes_on_from_its_own_fresh_episode() -> None:
    """Resets are computed only when some copy needs one; what the copies show is as if all were, at every step."""
    env, size = OfUnequalLength(), 4
    vector_env = GymnasiumVectorEnv(env, size)
    key, reset_key = jax.random.split(jax.random.key(5))
    state = jax.vmap(env.reset)(jax.random.split(reset_key, size))
    obs, _ = vector_env.reset(seed=5)
    np.testing.assert_array_equal(obs, state.obs)
    ends = 0
    for _ in range(30):
        obs, _, terminated, truncated, _ = vector_env.step(np.full((size, 1), -1.0, np.float32))
        last = jax.vmap(env.step)(state, jnp.full((size, 1), -1.0))
        key, reset_key = jax.random.split(key)
        fresh = jax.vmap(env.reset)(jax.random.split(reset_key, size))
        state = jax.tree.map(
            lambda new, old, done=last.done: jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old), fresh, last
        )
        np.testing.assert_allclose(obs, state.obs, atol=1e-6)
        np.testing.assert_array_equal(terminated | truncated, last.done)
        ends += int(last.done.sum())
    assert size < ends < 30 * size


@pytest.mark.filterwarnings("ignore")  # Brax's own deprecations
def test_to_brax_in_braxs_training_wrappers() -> None:
    brax_envs = pytest.importorskip("brax.envs")
    from brax.envs.wrappers import training

    ours = envs.make("Humanoid", physics="native")  # its actions reach to 0.4 only
    env = to_brax(ours)
    assert isinstance(env, brax_envs.Env)
    assert (env.observation_size, env.action_size, env.backend) == (270, 17, "native")
    with pytest.raises(ValueError, match=r"Humanoid: an action must have shape \(17,\), but has shape \(1,\)"):
        jax.eval_shape(env.step, jax.eval_shape(env.reset, jax.random.key(0)), jnp.zeros(1))
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


class Plain:
    """An environment of Brax's form that shows, earns and ends with what it is given."""

    observation_size: Any = 2
    action_size: Any = 1
    backend = "none"

    def __init__(self, **shown: Any):
        self.shown = {"obs": jnp.zeros(2), "reward": jnp.ones(()), "done": jnp.zeros(())} | shown

    def reset(self, rng: jax.Array) -> Any:
        del rng
        return Shown(obs=jnp.zeros(2), reward=jnp.zeros(()), done=jnp.zeros(()))

    def step(self, state: Any, action: jax.Array) -> Any:
        del state, action
        return Shown(**self.shown)


class Shown(NamedTuple):
    """What is read of a Brax state."""

    obs: Any
    reward: jax.Array
    done: jax.Array


def ones(*_: Any) -> jax.Array:
    """A cost."""
    return jnp.ones(())


def from_plain(cost: Any = ones, **shown: Any) -> FromBrax:
    return FromBrax(Plain(**shown), cost, name="plain")


@pytest.mark.parametrize(
    ("bad", "obs"),
    [
        ({"obs": jnp.array([jnp.nan, 3.0])}, [0.0, 3.0]),
        ({"reward": jnp.array(-jnp.inf)}, [0.0, 0.0]),
        ({"cost": lambda *_: jnp.array(jnp.nan)}, [0.0, 0.0]),
        ({"cost": lambda *_: jnp.array(-jnp.inf)}, [0.0, 0.0]),
    ],
)
def test_from_brax_ends_an_episode_where_a_number_is_not_finite(bad: dict[str, Any], obs: list[float]) -> None:
    env = from_plain(**bad)
    state = env.step(env.reset(jax.random.key(0)), jnp.zeros(1))
    assert state.terminated
    np.testing.assert_array_equal(state.obs, obs)
    assert [float(x) for x in (state.reward, state.cost, state.episode_return, state.episode_cost)] == [0.0] * 4
    assert np.isfinite(state.terms["reward"])
    sound = from_plain().step(env.reset(jax.random.key(0)), jnp.zeros(1))
    assert [float(x) for x in (sound.terminated, sound.reward, sound.cost)] == [0.0, 1.0, 1.0]


def test_from_brax_hides_no_negative_cost() -> None:
    env = from_plain(lambda *_: jnp.array(-0.5))
    start = env.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"plain: the cost function returned -0\.5"):
        env.step(start, jnp.zeros(1))
    compiled = jax.jit(env.step)(start, jnp.zeros(1))
    assert np.isnan(compiled.cost)
    assert np.isnan(compiled.episode_cost)


@pytest.mark.parametrize(
    ("shown", "message"),
    [
        ({"reward": jnp.zeros(1)}, r"plain: reward must have shape \(\), but has shape \(1,\)"),
        ({"cost": lambda *_: jnp.zeros(1)}, r"plain: cost must have shape \(\)"),
        ({"done": jnp.zeros(1)}, r"plain: done must have shape \(\)"),
        ({"obs": jnp.zeros((2, 1))}, r"plain: an observation must have shape \(2,\)"),
    ],
)
def test_from_brax_refuses_other_shapes(shown: dict[str, Any], message: str) -> None:
    env = from_plain(**shown)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(env.step, env.reset(jax.random.key(0)), jnp.zeros(1))
    with pytest.raises(ValueError, match="plain: an action"):
        env.step(env.reset(jax.random.key(0)), jnp.zeros(()))


def test_from_brax_shows_one_of_several_observations() -> None:
    class Several(Plain):
        observation_size: Any = {"state": (2,), "privileged_state": (5,)}  # noqa: RUF012

        def reset(self, rng: jax.Array) -> Any:
            return super().reset(rng)._replace(obs={"state": jnp.ones(2), "privileged_state": jnp.zeros(5)})

    env = FromBrax(Several(), ones, name="several", obs_key="state")
    assert env.obs_dim == 2
    np.testing.assert_array_equal(env.reset(jax.random.key(0)).obs, np.ones(2))
    for key in (None, "pixels"):
        with pytest.raises(ValueError, match=r"has observations 'state', 'privileged_state'; choose one .* obs_key"):
            FromBrax(Several(), ones, name="several", obs_key=key)
    with pytest.raises(ValueError, match="leave obs_key 'state' out"):
        FromBrax(Plain(), ones, name="plain", obs_key="state")


@pytest.mark.parametrize("size", [(64, 64, 3), "2", None, 1.5, ()])
def test_from_brax_refuses_what_is_no_row_of_numbers(size: Any) -> None:
    for field, what in (("observation_size", "an observation"), ("action_size", "an action")):
        with pytest.raises(ValueError, match=f"plain: {what} must be one row of numbers"):
            FromBrax(type("Odd", (Plain,), {field: size})(), ones, name="plain")
    env = FromBrax(type("Shaped", (Plain,), {"observation_size": (2,)})(), ones, name="plain")
    assert env.obs_dim == 2


@pytest.mark.filterwarnings("ignore")  # Brax's own deprecations
def test_from_brax_refuses_wrappers_that_hide_the_end_of_an_episode() -> None:
    brax_envs = pytest.importorskip("brax.envs")
    wrapped = brax_envs.create("fast", episode_length=5)  # as Brax itself wraps what it makes
    with pytest.raises(ValueError, match=r"wrapped in AutoResetWrapper, EpisodeWrapper, .*env\.unwrapped"):
        FromBrax(wrapped, ones, name="fast")
    assert FromBrax(wrapped.unwrapped, ones, name="fast").obs_dim == wrapped.observation_size


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Brax's own deprecations
def test_from_brax_ant_passes_the_environment_check() -> None:
    brax_envs = pytest.importorskip("brax.envs")
    original = brax_envs.get_environment("ant", backend="spring")
    check_environment(FromBrax(original, lambda before, action, after: jnp.abs(after.obs[0]), name="ant"))
