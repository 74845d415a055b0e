"""Where the time of an iteration goes: its parts, each compiled and timed by itself on the data that it has there."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from ccil_jax.acting import networks, rollout
from ccil_jax.agents import on_policy
from ccil_jax.learning import constraints, policy_step, reward_models
from ccil_jax.training import runner
from experiments.speed.measuring import (
    Setting,
    Work,
    make_config,
    noise,
    physics_work,
    rate_of,
    spread,
    training_work,
    wait,
)


def profile(setting: Setting) -> dict[str, Any]:
    """Microseconds per environment step, all seeds together, of each part, and their ratios to physics alone.

    The parts are measured in turn, `rounds` times, and the ratios taken within a round; medians. `environment` steps
    under the random actions that `physics alone` has; all else is what the policy of an untrained learner meets.
    """
    env: Any = envs.make(setting.task, physics=setting.physics)
    demonstrations = noise(env, setting)
    config = runner.resolve(make_config(setting), env, demonstrations)
    expert = runner.expert_data(demonstrations)
    num_seeds = setting.num_seeds
    constraint = constraints.make(config)
    policy = networks.make_policy(config, env.obs_dim, env.action_dim, on_policy.initial_std(env))
    critic = networks.make_scalar(config, env.obs_dim)
    reward_model = reward_models.task()
    if config.row.reward == "discriminator":
        assert expert is not None
        network = networks.make_scalar(config, env.obs_dim + env.action_dim, final_scale=0.01)
        reward_model = reward_models.discriminator(config, network, expert, env.obs_dim)
    zero, multiplier = jnp.zeros(()), jnp.asarray(0.5)

    def act(state: Any, key: jax.Array) -> Any:
        return rollout.rollout(env, policy.apply, state.actor, state.rollout, config.num_steps, key)

    def walk(state: Any, actions: jax.Array) -> Any:
        def step(env_state: Any, action: jax.Array) -> tuple[Any, Any]:
            env_state = jax.vmap(env.step)(env_state, action)
            return env_state, (env_state.obs, env_state.reward, env_state.cost)

        return jax.lax.scan(step, state.rollout.env_state, actions)

    def score(state: Any, transition: Any) -> Any:
        episodes = on_policy.episodes_of_steps(transition, zero, env.max_episode_steps)
        return on_policy.assess(config, critic.apply, reward_model, constraint, state, transition, episodes)[0]

    def split(samples: Any, key: jax.Array) -> Any:
        return policy_step.split(samples, config.num_held_out, policy_step.random_order(config, key))

    def improve(state: Any, training: Any, held_out: Any) -> Any:
        params = state.actor.policy_params
        return policy_step.improve(config, policy.apply, constraint, params, training, multiplier, zero, held_out)

    def fit(state: Any, training: Any, key: jax.Array) -> Any:
        return on_policy.fit_critics(config, critic.apply, state.critics, training, key)

    def discriminate(state: Any, transition: Any, key: jax.Array) -> Any:
        return reward_model.update(state.reward_model, transition, key)

    def outer(state: Any, taken: Any) -> Any:
        problem = policy_step.outer_problem(config, policy.apply, constraint, taken) if config.num_held_out else None
        return constraint.update(state.constraint, zero, problem)

    keys = jax.random.split(jax.random.key(setting.seed), num_seeds)
    state = spread(on_policy.make(config, env, expert).init, num_seeds)(keys)
    transition = spread(act, num_seeds)(state, keys)[1]
    held_out, training = spread(split, num_seeds)(spread(score, num_seeds)(state, transition), keys)
    taken = spread(improve, num_seeds)(state, training, held_out)[1]
    shape = (num_seeds, config.num_steps, config.num_envs, env.action_dim)
    low, high = jnp.asarray(env.action_low), jnp.asarray(env.action_high)
    actions = jax.random.uniform(jax.random.key(setting.seed), shape, minval=low, maxval=high)
    batch = num_seeds * config.batch_size
    iteration = batch * config.generator_steps

    def work(function: Any, steps: int, *arguments: Any) -> Work:
        compiled = spread(function, num_seeds)

        def run() -> int:
            wait(compiled(*arguments))
            return steps

        return run

    parts = {
        "physics alone": physics_work(env, setting),
        "environment": work(walk, batch, state, actions),
        "rollout": work(act, batch, state, keys),
        "reward, values, advantages": work(score, batch, state, transition),
        "policy step": work(improve, batch, state, training, held_out),
        "critics": work(fit, batch, state, training, keys),
        "discriminator": work(discriminate, iteration, state, transition, keys),
        "multiplier": work(outer, iteration, state, taken),
        "training": training_work(config, env, setting)[0],
    }
    for run in parts.values():
        run()  # compiles, and warms caches
    times = {name: np.zeros(setting.rounds) for name in parts}
    for i in range(setting.rounds):
        for name, run in parts.items():
            times[name][i] = 1e6 / rate_of(run, setting.seconds)
    return {
        "task": setting.task,
        "physics": env.physics_name,
        "method": setting.method,
        "num_seeds": num_seeds,
        "num_envs": setting.num_envs,
        "parts": {
            name: {
                "microseconds_per_step": float(np.median(values)),
                "to_physics": float(np.median(values / times["physics alone"])),
            }
            for name, values in times.items()
        },
    }
