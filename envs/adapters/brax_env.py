"""Our tasks as Brax environments, and environments of Brax's form as ours."""

import operator
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import State, check_shape, executed, first_state, next_state
from envs.costs import checked_cost
from envs.options import check_count
from envs.task_info import physics_name

BraxState = Any
# Parts of the names of wrappers' classes after which a step no longer says how the episode goes on.
HIDING_WRAPPERS = ("AutoReset", "Episode", "Vmap", "Eval")


def to_brax(env: Any) -> Any:
    """One of ours as a `brax.envs.Env`.

    It follows Brax's conventions: actions are in [-1, 1] and are mapped to our range of actions; `done` means
    termination alone; and the time limit is kept by the wrapper `EpisodeWrapper`, to which the caller gives
    `env.max_episode_steps`. `info["cost"]` is the cost of the step, `metrics` has the cost and the terms of the reward,
    and `pipeline_state` is our whole `State`.
    """
    import brax.envs

    class BraxEnvironment(brax.envs.Env):  # type: ignore[misc]  # brax is untyped
        """See `to_brax`."""

        observation_size = env.obs_dim
        action_size = env.action_dim
        backend = physics_name(env)
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

    Where an observation, reward or cost is NaN or infinite, the episode terminates, as in our own tasks: that step
    earns and costs nothing, and what is not finite is shown as 0. A negative cost is refused, or NaN in a compiled
    program: see `envs.costs.checked_cost`.

    Args:
        env: the environment without wrappers, with actions in [-1, 1]. Its `done` is taken for termination.
        cost: a function of the state before, the action and the state after, both states in the original's form;
            returns a scalar >= 0.
        name: of the task, for messages and logs.
        max_episode_steps: control steps until truncation.
        obs_key: where `env` has several observations by name (as Playground's "state" and "privileged_state"): the
            name of the one that is shown. None where it has one observation.

    Raises:
        ValueError: a wrapper of `env` hides where an episode ends; an observation or an action is not one row of
            numbers; or `obs_key` does not fit to `env`.
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
        cost, finite = checked_cost(self.name, self._cost(state.physics, action, new))
        return next_state(
            state,
            physics=new,
            obs=obs,
            reward=reward,
            cost=cost,
            terminated=self._scalar("done", new.done) > 0.5,
            terms={"reward": reward},
            max_episode_steps=self.max_episode_steps,
            finite=jnp.isfinite(obs).all() & jnp.isfinite(reward) & finite,
        )

    def _observe(self, state: BraxState) -> jax.Array:
        obs = state.obs if self._obs_key is None else state.obs[self._obs_key]
        check_shape(f"{self.name}: an observation", obs, (self.obs_dim,))
        return jnp.asarray(obs, jnp.result_type(float))

    def _scalar(self, what: str, value: jax.typing.ArrayLike) -> jax.Array:
        check_shape(f"{self.name}: {what}", value, ())
        return jnp.asarray(value, jnp.result_type(float))


def _wrappers(env: Any) -> Iterator[str]:
    """Names of the wrappers' classes, the outermost first."""
    while (inner := getattr(env, "__dict__", {}).get("env")) is not None:
        yield type(env).__name__
        env = inner


def _length(what: str, size: Any) -> int:
    """The length of a row of numbers. Brax says sizes as a number or as a shape."""
    try:
        (length,) = size if isinstance(size, tuple | list) else (size,)
        return operator.index(length)
    except (TypeError, ValueError):
        raise ValueError(
            f"{what} must be one row of numbers, but its size is {size!r}; flatten it in a wrapper"
        ) from None
