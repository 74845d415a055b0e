"""Our tasks as gymnasium's environments: one at a time, or many as one vector environment."""

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

import envs
from envs.base import State, check_shape
from envs.jax_tools import compute_where
from envs.options import check_count

_NO_LIMIT = 2**31 - 1  # control steps: more than any episode has
_LARGEST = np.finfo(np.float32).max  # of an observation, which is always finite


def spaces_of(env: Any) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """The spaces of observations and actions, float32: `[obs_dim]` of any finite numbers, and `[action_dim]`."""
    low, high = (np.broadcast_to(x, env.action_dim).astype(np.float32) for x in (env.action_low, env.action_high))
    observations = gymnasium.spaces.Box(-_LARGEST, _LARGEST, (env.obs_dim,), np.float32)
    return observations, gymnasium.spaces.Box(low, high, dtype=np.float32)


def first_key(seed: int | None) -> jax.Array:
    """The random key from which the episodes of an environment follow; by chance where `seed` is None."""
    return jax.random.key(np.random.SeedSequence().generate_state(1)[0] if seed is None else seed)


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One of our environments as a `gymnasium.Env`. Nothing is drawn: `render_mode` can be None only.

    `info["cost"]` is the cost of the step just taken.

    Args:
        env: one of ours.

    Raises:
        ValueError: another `render_mode` is given.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  # gymnasium declares it so

    def __init__(self, env: Any, render_mode: str | None = None):
        if render_mode is not None:
            raise ValueError(f"{env.name}: render_mode {render_mode!r}: this environment cannot be drawn; leave it out")
        self.env, self.render_mode = env, None
        self.observation_space, self.action_space = spaces_of(env)
        self._key: jax.Array | None = None
        self._state: State | None = None
        self._reset = jax.jit(self._start)
        self._step = jax.jit(env.step)

    @jax.transfer_guard("allow")  # the caller has NumPy arrays
    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode. The same `seed` gives the same episodes under the same actions."""
        super().reset(seed=seed, options=options)
        if seed is not None or self._key is None:
            self._key = first_key(seed)
        self._key, self._state = self._reset(self._key)
        return np.array(self._state.obs), {}

    @jax.transfer_guard("allow")
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advances one control step. The action `[action_dim]` is clipped to the action space."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state = state = self._step(self._state, np.asarray(action))
        info = {"cost": float(state.cost)}
        return np.array(state.obs), float(state.reward), bool(state.terminated), bool(state.truncated), info

    def _start(self, key: jax.Array) -> tuple[jax.Array, State]:
        key, reset_key = jax.random.split(key)
        return key, self.env.reset(reset_key)


class GymnasiumVectorEnv(VectorEnv):
    """`num_envs` copies of one of our environments as a `gymnasium.vector.VectorEnv`.

    A copy is reset in the same step in which its episode ends (gymnasium's mode `SAME_STEP`). `info["cost"]`
    `[num_envs]` is the cost of the step just taken, also where the episode ended. Where it ended, `info["final_obs"]`
    has the last observation of that episode, and `info["final_info"]` has cost, episode return and episode cost. As in
    gymnasium, `info["_final_obs"]` marks the copies to which this applies.

    Args:
        env: one of ours.
        num_envs: number of copies, which are stepped as one batch.
    """

    def __init__(self, env: Any, num_envs: int):
        check_count("num_envs", num_envs)
        self.env, self.num_envs = env, num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self.render_mode = None
        self.single_observation_space, self.single_action_space = spaces_of(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._key: jax.Array | None = None
        self._state: State | None = None
        self._reset = jax.jit(self._start)
        self._step = jax.jit(self._advance)

    @jax.transfer_guard("allow")  # the caller has NumPy arrays
    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts all episodes. The same `seed` gives the same episodes under the same actions."""
        del options
        if seed is not None or self._key is None:
            self._key = first_key(seed)
        self._key, self._state = self._reset(self._key)
        return np.array(self._state.obs), {}

    @jax.transfer_guard("allow")
    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances all copies by one control step. Actions [num_envs, action_dim] are clipped to the action space."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        check_shape(f"{self.env.name}: the actions", actions, (self.num_envs, self.env.action_dim))
        self._key, self._state, taken = self._step(self._key, self._state, np.asarray(actions))
        obs, last_obs, reward, cost, terminated, truncated, total, total_cost = map(np.array, taken)
        done = terminated | truncated
        info: dict[str, Any] = {"cost": cost, "_cost": np.ones(self.num_envs, bool)}
        if done.any():
            final_obs = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(done):
                final_obs[i] = last_obs[i]
            final = {"cost": cost, "episode_return": total, "episode_cost": total_cost}
            info |= {"final_obs": final_obs, "_final_obs": done, "_final_info": done}
            info["final_info"] = {name: np.where(done, value, 0.0) for name, value in final.items()}
            info["final_info"] |= {f"_{name}": done for name in final}
        return obs, reward.astype(np.float64), terminated, truncated, info

    def _start(self, key: jax.Array) -> tuple[jax.Array, State]:
        key, reset_key = jax.random.split(key)
        return key, jax.vmap(self.env.reset)(jax.random.split(reset_key, self.num_envs))

    def _advance(
        self, key: jax.Array, state: State, actions: jax.Array
    ) -> tuple[jax.Array, State, tuple[jax.Array, ...]]:
        """The next key, the states to go on from, and the arrays that `step` returns (see there)."""
        last = jax.vmap(self.env.step)(state, actions)
        key, reset_key = jax.random.split(key)

        def refresh(state: State, key: jax.Array) -> State:
            return compute_where(state.done, self.env.reset, state, key)

        state = jax.vmap(refresh)(last, jax.random.split(reset_key, self.num_envs))
        totals = last.episode_return, last.episode_cost
        return key, state, (state.obs, last.obs, last.reward, last.cost, last.terminated, last.truncated, *totals)


def make_single(task: str, render_mode: str | None = None, **options: Any) -> GymnasiumEnv:
    """What `gymnasium.make` calls. Episodes are truncated by gymnasium's wrapper `TimeLimit`, which it adds itself.

    Args:
        task: see `envs.make`.
        render_mode: None.
        **options: of `envs.make`.
    """
    if "max_episode_steps" in envs.find_task(task).common:
        options = {"max_episode_steps": _NO_LIMIT, **options}
    return GymnasiumEnv(envs.make(task, **options), render_mode)


def make_vector(task: str, num_envs: int, render_mode: str | None = None, **options: Any) -> GymnasiumVectorEnv:
    """What `gymnasium.make_vec` calls; see `make_single`. Here the time limit is the task's option."""
    if render_mode is not None:
        raise ValueError(f"{task}: render_mode {render_mode!r}: this environment cannot be drawn; leave it out")
    return GymnasiumVectorEnv(envs.make(task, **options), num_envs)
