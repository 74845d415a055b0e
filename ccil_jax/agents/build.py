"""The agent of a method, and agents made of a user's own parts."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ccil_jax import user_code
from ccil_jax.acting.networks import Network, Policy
from ccil_jax.agents import behavior_cloning, contracts, iq_learn, on_policy
from ccil_jax.agents.base import Agent
from ccil_jax.agents.expert import expert_of
from ccil_jax.config import Config, validate, with_limit_of
from ccil_jax.demonstrations.trajectories import Demonstrations, check_time_limit
from ccil_jax.errors import ConfigError
from ccil_jax.learning.constraints import Constraint
from ccil_jax.learning.optimizers import Optimizer
from ccil_jax.learning.reward_models import RewardModel
from ccil_jax.types import ExpertData
from envs.base import Environment, mirror_of
from envs.jax_tools import full_precision


def _as_it_is(config: Config, env: Environment, demonstrations: Demonstrations) -> Config:
    return config


class Kind(NamedTuple):
    """How one kind of agent is built."""

    make: Callable[..., Agent]  # config, env, expert, and those of `parts` that are given, by keyword
    parts: tuple[str, ...] = ()  # what can be put in the place of its own
    resolve: Callable[[Config, Environment, Demonstrations], Config] = _as_it_is


AGENTS: Mapping[str, Kind] = {  # by the names in `METHODS`
    "on_policy": Kind(
        on_policy.make, ("constraint", "reward_model", "policy", "critic", "optimizer"), on_policy.resolve
    ),
    "behavior_cloning": Kind(behavior_cloning.make, ("policy", "optimizer")),
    "iq_learn": Kind(iq_learn.make, ("policy", "critic", "optimizer"), iq_learn.resolve),
}


def kind_of(config: Config) -> Kind:
    """How the agent of `config.method` is built. A function of the user's own takes no further parts."""
    part = config.row.agent
    return Kind(part) if callable(part) else AGENTS[part]


def make(config: Config, env: Environment, expert: ExpertData | None, **own: Any) -> Agent:
    """Builds the agent of `config.method`.

    Args:
        config: resolved, see `resolve`.
        env: the task, unbatched.
        expert: the demonstrations on the device; None for a method that learns without.
        **own: parts in the place of the method's own, see `make_agent`.

    Raises:
        ConfigError: the agent has no such part.
    """
    kind = kind_of(config)
    for name in own:
        if name not in kind.parts:
            known = ", ".join(kind.parts) or "none"
            raise ConfigError(
                f"{name}: makes no difference to method {config.method}; leave it out (its parts: {known})"
            )
    if "constraint" in own and config.row.limit is None:
        raise ConfigError(f"constraint: method {config.method} has no cost limit to keep; use ccil, or lgail")
    if "optimizer" in own:
        own["optimizer"] = contracts.optimizer(own["optimizer"])
    return kind.make(config, env, expert, **own)


def make_agent(
    config: Config,
    env: Environment,
    demonstrations: Demonstrations | None = None,
    *,
    constraint: Constraint | None = None,
    reward_model: RewardModel | None = None,
    policy: Policy | None = None,
    critic: Network | None = None,
    optimizer: Optimizer | None = None,
) -> Agent:
    """The learner of `config.method` as two pure functions, to be used in code of your own.

        agent = ccil_jax.make_agent(ccil_jax.Config(method="ccil"), env, demonstrations)
        state = jax.vmap(agent.init)(jax.random.split(jax.random.key(0), num_seeds))
        state, metrics = jax.jit(jax.vmap(agent.step))(state)

    `agent.step` is one iteration. It can be jitted, vmapped, scanned and differentiated; `state.actor` is what
    `ccil_jax.evaluate` and `ccil_jax.record` play. Unlike `ccil_jax.train` it does not take back an iteration that
    yields NaN or infinity.

    Args:
        config: hyperparameters; the cost limit is taken from the demonstrations where the method says so.
        env: the task, unbatched.
        demonstrations: needed by the methods that imitate.
        constraint: how the cost enters, instead of the method's own.
        reward_model: where the reward comes from, instead of the method's own.
        policy: the policy network, instead of the method's own. Its `apply(params, obs)` returns a
            `Gaussian` of `ccil_jax.acting.distributions` with means [..., action_dim] and log-deviations [action_dim];
            for `iq_learn` a `TanhGaussian`, whose log-deviations are [..., action_dim].
        critic: the network of a value function, [..., obs_dim] -> [...]; the reward's and the cost's critic are two
            sets of its parameters. For `iq_learn` it is the Q-function, [..., obs_dim + action_dim] -> [...].
        optimizer: learning rate -> `optax.GradientTransformation`, instead of Adam, for critics and discriminator,
            and for the policies of `bc` and `iq_learn`. The multiplier's steps are the constraint's own.

    Raises:
        ConfigError: the pieces do not fit together, or a part would make no difference to the method.
        DemonstrationsError: an episode of the demonstrations is longer than the environment's.
    """
    config = resolve(config, env, demonstrations)
    given = {
        "constraint": constraint,
        "reward_model": reward_model,
        "policy": policy,
        "critic": critic,
        "optimizer": optimizer,
    }
    own = {name: part for name, part in given.items() if part is not None}
    agent = make(config, env, expert_of(config, env, demonstrations), **own)
    return Agent(init=full_precision(agent.init), step=full_precision(agent.step))


def resolve(config: Config, env: Environment, demonstrations: Demonstrations | None) -> Config:
    """Checks that the pieces fit and sets the cost limit, before anything is compiled.

    Raises:
        ConfigError: options, environment and demonstrations do not fit together.
        DemonstrationsError: an episode of the demonstrations is longer than the environment's.
    """
    _check_types(config, env, demonstrations)
    validate(config)
    if config.row.imitates:
        if demonstrations is None:
            raise ConfigError(f"method {config.method} needs demonstrations; pass some, or use method trpo or expert")
        for name, array, size in (
            ("obs", demonstrations.obs, env.obs_dim),
            ("actions", demonstrations.actions, env.action_dim),
        ):
            if array.shape[1:] != (size,):
                found = f"{array.shape[1]} columns" if array.ndim == 2 else f"shape {array.shape}, no rows,"
                raise ConfigError(f"demonstrations: {name} has {found} but {env.name} has {size}")
        check_time_limit(demonstrations, "demonstrations", env.max_episode_steps)
        try:
            mirror_of(env)
        except ValueError as error:
            raise ConfigError(str(error)) from error
    if demonstrations is None:
        return config
    config = with_limit_of(config, demonstrations.mean_episode_cost)
    return kind_of(config).resolve(config, env, demonstrations)


def _check_types(config: Any, env: Any, demonstrations: Any) -> None:
    """Raises `ConfigError` for names in the place of what they name, and for classes in the place of their objects."""
    user_code.check_type("config", config, Config)
    if isinstance(env, str | type) or not hasattr(env, "reset"):
        found = repr(env) if isinstance(env, str | type) else f"of type {type(env).__name__}"
        raise ConfigError(f"env: is {found}; give an environment, such as envs.make('Swimmer')")
    if demonstrations is not None and not isinstance(demonstrations, Demonstrations):
        found = type(demonstrations).__name__
        raise ConfigError(f"demonstrations: is of type {found}; give what ccil_jax.load_demonstrations returns")
