"""Our tasks for other libraries' learners, and other libraries' tasks for ours.

* `GymnasiumVectorEnv(env, num_envs)`: ours as a `gymnasium.vector.VectorEnv`.
* `to_brax(env)`: ours as a `brax.envs.Env`.
* `FromBrax(env, cost)`: a Brax environment, or one of like form (MuJoCo Playground), with a cost function, as ours.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from envs.base import State, first_state, next_state

BraxState = Any


class GymnasiumVectorEnv(VectorEnv):
    """`num_envs` copies of one of our environments, reset in the step that ends an episode (`SAME_STEP`).

    `info["cost"]` `[num_envs]` is the cost of the step just taken, also where the episode ended. There,
    `info["final_obs"]` has the true successor and `info["final_info"]` cost, episode return and episode cost; as in
    gymnasium, `info["_final_obs"]` marks those entries.

    Args:
        env: one of ours with `action_low` and `action_high`.
        num_envs: copies, stepped as one batch.
    """

    def __init__(self, env: Any, num_envs: int):
        self.env, self.num_envs = env, num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self.render_mode = None
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (env.obs_dim,), np.float32)
        low, high = (np.broadcast_to(x, env.action_dim).astype(np.float32) for x in (env.action_low, env.action_high))
        self.single_action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._key: jax.Array | None = None
        self._state: State | None = None
        self._reset = jax.jit(self._start)
        self._step = jax.jit(self._advance)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts all episodes. The same `seed` gives the same episodes under the same actions."""
        del options
        if seed is not None or self._key is None:
            self._key = jax.random.key(np.random.SeedSequence().generate_state(1)[0] if seed is None else seed)
        self._key, self._state = self._reset(self._key)
        return np.array(self._state.obs), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances all copies by one control step. Actions are clipped to the action space."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._key, last, self._state = self._step(self._key, self._state, jnp.asarray(actions))
        terminated, truncated, cost = np.array(last.terminated), np.array(last.truncated), np.array(last.cost)
        done = terminated | truncated
        info: dict[str, Any] = {"cost": cost, "_cost": np.ones(self.num_envs, bool)}
        if done.any():
            final_obs = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(done):
                final_obs[i] = np.array(last.obs[i])
            final = {"cost": cost, "episode_return": last.episode_return, "episode_cost": last.episode_cost}
            info |= {"final_obs": final_obs, "_final_obs": done, "_final_info": done}
            info["final_info"] = {name: np.where(done, value, 0.0) for name, value in final.items()}
            info["final_info"] |= {f"_{name}": done for name in final}
        return np.array(self._state.obs), np.array(last.reward, np.float64), terminated, truncated, info

    def _start(self, key: jax.Array) -> tuple[jax.Array, State]:
        key, reset_key = jax.random.split(key)
        return key, jax.vmap(self.env.reset)(jax.random.split(reset_key, self.num_envs))

    def _advance(self, key: jax.Array, state: State, actions: jax.Array) -> tuple[jax.Array, State, State]:
        """The next key, the true successors, and the states to go on from."""
        last = jax.vmap(self.env.step)(state, actions)
        key, fresh = self._start(key)

        def select(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(last.done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        return key, last, jax.tree.map(select, fresh, last)


def to_brax(env: Any) -> Any:
    """One of ours as a `brax.envs.Env`.

    By Brax's conventions actions are in [-1, 1] (mapped to our action range), `done` is termination alone, and the
    time limit is the caller's `EpisodeWrapper`'s: give it `env.max_episode_steps`. `info["cost"]` has the step's
    cost, `metrics` cost and reward terms, `pipeline_state` our whole `State`.
    """
    import brax.envs

    class BraxEnvironment(brax.envs.Env):  # type: ignore[misc]  # brax is untyped
        """See `to_brax`."""

        observation_size = env.obs_dim
        action_size = env.action_dim
        backend = getattr(env, "physics_name", "unknown")
        dt = getattr(env, "dt", None)

        def reset(self, rng: jax.Array) -> BraxState:
            return brax.envs.State(**parts(env.reset(rng)), info={"cost": jnp.zeros(())})

        def step(self, state: BraxState, action: jax.Array) -> BraxState:
            low, high = jnp.asarray(env.action_low), jnp.asarray(env.action_high)
            new = env.step(state.pipeline_state, low + (jnp.clip(action, -1.0, 1.0) + 1.0) / 2.0 * (high - low))
            return state.replace(**parts(new), info=state.info | {"cost": new.cost})

    def parts(state: State) -> dict[str, Any]:
        return {
            "pipeline_state": state,
            "obs": state.obs,
            "reward": state.reward,
            "done": state.terminated.astype(state.reward.dtype),
            "metrics": {"cost": state.cost, **state.terms},
        }

    return BraxEnvironment()


class FromBrax:
    """A Brax or Playground environment with a cost, as an `Environment` of ours.

    Args:
        env: unwrapped, with array observations and actions in [-1, 1]. Its `done` is taken for termination.
        cost: of (state before, action, state after), all in the original's form; a scalar >= 0.
        name: for logs.
        max_episode_steps: control steps until truncation.
    """

    def __init__(
        self,
        env: Any,
        cost: Callable[[BraxState, jax.Array, BraxState], jax.Array],
        *,
        name: str,
        max_episode_steps: int = 1000,
    ):
        self._env, self._cost = env, cost
        self.name, self.max_episode_steps = name, max_episode_steps
        self.obs_dim, self.action_dim = int(env.observation_size), int(env.action_size)
        self.action_low, self.action_high = -np.ones(self.action_dim, np.float32), np.ones(self.action_dim, np.float32)
        self.physics_name = str(getattr(env, "backend", type(env).__name__))

    def reset(self, key: jax.Array) -> State:
        """Starts an episode; `key` is consumed."""
        start = self._env.reset(key)
        return first_state(start, start.obs, ("reward",))

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step."""
        action = jnp.clip(action, self.action_low, self.action_high)
        new = self._env.step(state.physics, action)
        reward = jnp.asarray(new.reward, state.reward.dtype)
        cost = jnp.asarray(self._cost(state.physics, action, new), state.cost.dtype)
        return next_state(
            state,
            physics=new,
            obs=new.obs,
            reward=reward,
            cost=cost,
            terminated=new.done > 0.5,
            terms={"reward": reward},
            max_episode_steps=self.max_episode_steps,
        )
