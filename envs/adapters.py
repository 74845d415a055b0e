"""Our tasks for other libraries' learners, and other libraries' tasks for ours.

* `GymnasiumVectorEnv(env, num_envs)`: ours as a `gymnasium.vector.VectorEnv`.
* `to_brax(env)`: ours as a `brax.envs.Env`.
* `FromBrax(env, cost)`: a Brax environment, or one of like form (MuJoCo Playground), with a cost function, as ours.
"""

import operator
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from envs.base import State, check_shape, executed, first_state, next_state
from envs.jax_tools import compute_where
from envs.options import check_count

BraxState = Any
# Wrappers, by parts of their classes' names, after which a step no longer says how the episode goes on.
HIDING_WRAPPERS = ("AutoReset", "Episode", "Vmap", "Eval")


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
        check_count("num_envs", num_envs)
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

    @jax.transfer_guard("allow")  # the caller has NumPy arrays
    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts all episodes. The same `seed` gives the same episodes under the same actions."""
        del options
        if seed is not None or self._key is None:
            self._key = jax.random.key(np.random.SeedSequence().generate_state(1)[0] if seed is None else seed)
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
        """The next key, the states to go on from, and what `step` tells of those and of the true successors."""
        last = jax.vmap(self.env.step)(state, actions)
        key, reset_key = jax.random.split(key)

        def refresh(state: State, key: jax.Array) -> State:
            return compute_where(state.done, self.env.reset, state, key)

        state = jax.vmap(refresh)(last, jax.random.split(reset_key, self.num_envs))
        totals = last.episode_return, last.episode_cost
        return key, state, (state.obs, last.obs, last.reward, last.cost, last.terminated, last.truncated, *totals)


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
            check_shape(f"{getattr(env, 'name', 'task')}: an action", action, (env.action_dim,))
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

    Where an observation, reward or cost is NaN or infinite the episode terminates, as in our own tasks: nothing is
    earned or paid, and what is not finite is shown as 0.

    A negative cost is a mistake in `cost`, which nobody should train on. Called directly, `step` refuses it. A compiled
    program cannot raise errors, so there the cost is NaN, which nothing that reads it can overlook: evaluations are
    NaN, and training takes its updates back and stops (`Config.max_skipped_updates`).

    Args:
        env: unwrapped, with actions in [-1, 1]. Its `done` is taken for termination.
        cost: of (state before, action, state after), all in the original's form; a scalar >= 0.
        name: for logs.
        max_episode_steps: control steps until truncation.
        obs_key: which of its observations is shown, where `env` has several by name (as Playground's "state" and
            "privileged_state"); None where it has one.

    Raises:
        ValueError: `env` is wrapped so that a step hides the episode's end; its observation or action is not one row
            of numbers; or `obs_key` does not fit.
    """

    def __init__(
        self,
        env: Any,
        cost: Callable[[BraxState, jax.Array, BraxState], jax.Array],
        *,
        name: str,
        max_episode_steps: int = 1000,
        obs_key: str | None = None,
    ):
        check_count(f"{name}: max_episode_steps", max_episode_steps)
        hiding = [kind for kind in _wrappers(env) if any(part in kind for part in HIDING_WRAPPERS)]
        if hiding:
            raise ValueError(
                f"{name}: the environment is wrapped in {', '.join(hiding)}, which hides where an episode ends; "
                "give it unwrapped (`env.unwrapped`): limits, batches and resets are the learner's"
            )
        self._env, self._cost, self._obs_key = env, cost, obs_key
        self.name, self.max_episode_steps = name, max_episode_steps
        size = env.observation_size
        named = ", ".join(map(repr, size)) if isinstance(size, Mapping) else ""
        if isinstance(size, Mapping) and obs_key not in size:
            raise ValueError(f"{name}: has observations {named}; choose one of them by obs_key, not {obs_key!r}")
        if not named and obs_key is not None:
            raise ValueError(f"{name}: has one observation without a name; leave obs_key {obs_key!r} out")
        self.obs_dim = _length(f"{name}: an observation", size[obs_key] if named else size)
        self.action_dim = _length(f"{name}: an action", env.action_size)
        self.action_low, self.action_high = -np.ones(self.action_dim, np.float32), np.ones(self.action_dim, np.float32)
        self.physics_name = str(getattr(env, "backend", type(env).__name__))

    def reset(self, key: jax.Array) -> State:
        """Starts an episode; `key` is consumed."""
        start = self._env.reset(key)
        return first_state(start, self._observe(start), ("reward",))

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step. See `Environment.step`."""
        action = executed(self, action)
        new = self._env.step(state.physics, action)
        obs, reward = self._observe(new), self._scalar("reward", new.reward)
        cost = self._scalar("cost", self._cost(state.physics, action, new))
        negative = jnp.isfinite(cost) & (cost < 0)
        if not isinstance(negative, jax.core.Tracer) and negative:
            raise ValueError(f"{self.name}: the cost function returned {float(cost):g}; costs are 0 or more")
        return next_state(
            state,
            physics=new,
            obs=obs,
            reward=reward,
            cost=jnp.where(negative, jnp.nan, cost),
            terminated=self._scalar("done", new.done) > 0.5,
            terms={"reward": reward},
            max_episode_steps=self.max_episode_steps,
            finite=jnp.isfinite(obs).all() & jnp.isfinite(reward) & jnp.isfinite(cost),
        )

    def _observe(self, state: BraxState) -> jax.Array:
        obs = state.obs if self._obs_key is None else state.obs[self._obs_key]
        check_shape(f"{self.name}: an observation", obs, (self.obs_dim,))
        return jnp.asarray(obs, jnp.result_type(float))

    def _scalar(self, what: str, value: jax.typing.ArrayLike) -> jax.Array:
        check_shape(f"{self.name}: {what}", value, ())
        return jnp.asarray(value, jnp.result_type(float))


def _wrappers(env: Any) -> Iterator[str]:
    """Names of the classes around the innermost environment, from outside."""
    while (inner := getattr(env, "__dict__", {}).get("env")) is not None:
        yield type(env).__name__
        env = inner


def _length(what: str, size: Any) -> int:
    """Of a row of numbers, whose size is said as a number or as a shape."""
    try:
        (length,) = size if isinstance(size, tuple | list) else (size,)
        return operator.index(length)
    except (TypeError, ValueError):
        raise ValueError(
            f"{what} must be one row of numbers, but its size is {size!r}; flatten it in a wrapper"
        ) from None
