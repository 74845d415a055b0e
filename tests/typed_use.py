"""What a type checker tells a user: every `ignore` below stands for an error that it reports, or mypy complains of it.

Nothing here is run.
"""

import ccil_jax
import envs


def wrong_keywords() -> None:
    """Misspelt names, one a line."""
    env = envs.make("Swimmer", max_steps=10)  # type: ignore[arg-type]
    demonstrations = ccil_jax.load_demonstrations("expert.npz", default_costs=0.0)  # type: ignore[call-arg]
    config = ccil_jax.Config(metod="ccil")  # type: ignore[call-arg]
    config = ccil_jax.Config.from_preset("paper", gama=0.9)  # type: ignore[call-arg]
    result = ccil_jax.train(config, env, demonstrations, nun_seeds=3)  # type: ignore[call-arg]
    ccil_jax.evaluate(result.config, result.actor, env, episodes=3)  # type: ignore[call-arg]
    ccil_jax.make_agent(config, env, demonstrations, constrain=ccil_jax.Constraint())  # type: ignore[call-arg]
    ccil_jax.register_method("mine", ccil_jax.Method(rewards="task"))  # type: ignore[call-arg]
    envs.register("Mine", dict, costs="effort")  # type: ignore[call-arg]


def right_uses() -> None:
    """Nothing to report."""
    env: envs.Environment = envs.make("Ant", "native", max_episode_steps=3, cost_threshold=0.5, contact_cost=False)
    envs.make("Mine", options={"size": 3})
    cheaper: envs.Environment = envs.with_cost(env, lambda before, action, after: action.sum())
    vector: envs.GymnasiumVectorEnv = envs.GymnasiumVectorEnv(cheaper, 3)
    assert vector is not None


def wrong_names() -> None:
    """Names that the packages do not have."""
    envs.with_costs  # type: ignore[attr-defined]  # noqa: B018
    ccil_jax.trian  # type: ignore[attr-defined]  # noqa: B018


def wrong_types() -> None:
    """Values of another kind."""
    envs.make("Swimmer", max_episode_steps="3")  # type: ignore[arg-type]
    ccil_jax.Config(env_steps="many")  # type: ignore[arg-type]
    ccil_jax.Config.from_preset("paper", hidden_sizes=64)  # type: ignore[arg-type]
