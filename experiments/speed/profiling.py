"""Where the time of an iteration goes: each of its parts is compiled and timed separately, on data of an iteration."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from ccil_jax.acting import rollout
from ccil_jax.agents import build, on_policy
from ccil_jax.agents.expert import expert_of
from ccil_jax.agents.on_policy import AgentState, Parts
from ccil_jax.learning import policy_step
from ccil_jax.learning.policy_step import PolicyStep
from ccil_jax.types import Batch, Transition
from envs.task_info import physics_name
from experiments.speed.measuring import (
    Work,
    physics_work,
    rate_of,
    spread,
    training_work,
    wait,
)
from experiments.speed.setting import Setting, make_config, noise

PHYSICS = "physics alone"


class Pieces(NamedTuple):
    """The parts of an iteration as functions of one seed; S of them are vmapped."""

    walk: Callable[[AgentState, jax.Array], Any]  # state, actions [T, N, action_dim]: the environment alone
    act: Callable[[AgentState, jax.Array], Any]  # state, key: a rollout
    score: Callable[[AgentState, Transition], Batch]
    split: Callable[[Batch, jax.Array], tuple[Batch, Batch]]  # samples, key -> held out, training
    improve: Callable[[AgentState, Batch, Batch], Any]  # state, training, held out: a policy step
    fit: Callable[[AgentState, Batch, jax.Array], Any]  # both critics
    discriminate: Callable[[AgentState, Transition, jax.Array], Any]
    constrain: Callable[[AgentState, PolicyStep], Any]  # the dual step, and the outer step where there is one


def pieces_of(parts: Parts) -> Pieces:
    """The pieces of `on_policy.step`, with a multiplier of 0.5 and no cost gap."""
    config, env, policy, constraint = parts.config, parts.env, parts.policy, parts.constraint
    zero, multiplier = jnp.zeros(()), jnp.asarray(0.5)

    def walk(state: AgentState, actions: jax.Array) -> Any:
        def step(env_state: Any, action: jax.Array) -> tuple[Any, Any]:
            env_state = jax.vmap(env.step)(env_state, action)
            return env_state, (env_state.obs, env_state.reward, env_state.cost)

        return jax.lax.scan(step, state.rollout.env_state, actions)

    def act(state: AgentState, key: jax.Array) -> Any:
        return rollout.rollout(env, policy.apply, state.learner, state.rollout, config.num_steps, key)

    def score(state: AgentState, transition: Transition) -> Batch:
        samples, _ = on_policy.assess(parts, state, transition)
        return samples

    def split(samples: Batch, key: jax.Array) -> tuple[Batch, Batch]:
        return policy_step.split(samples, config.num_held_out, policy_step.random_order(config, key))

    def improve(state: AgentState, training: Batch, held_out: Batch) -> Any:
        params, steps = state.learner.policy_params, on_policy.expert_steps(parts, state, jax.random.key(0))
        return policy_step.improve(
            config, policy.apply, constraint, params, training, multiplier, zero, held_out, steps
        )

    def fit(state: AgentState, training: Batch, key: jax.Array) -> Any:
        return on_policy.fit_critics(parts, state.critics, training, key)

    def discriminate(state: AgentState, transition: Transition, key: jax.Array) -> Any:
        return parts.reward_model.update(state.reward_model, transition, key)

    def constrain(state: AgentState, taken: PolicyStep) -> Any:
        problem = policy_step.outer_problem(config, policy.apply, constraint, taken) if config.num_held_out else None
        return constraint.update(state.constraint, zero, problem)

    return Pieces(walk, act, score, split, improve, fit, discriminate, constrain)


def works(setting: Setting, env: Any) -> dict[str, Work]:
    """The work that is timed, by name: each piece for all seeds together, on data of an untrained learner."""
    demonstrations = noise(env, setting)
    config = build.resolve(make_config(setting), env, demonstrations)
    parts = on_policy.make_parts(config, env, expert_of(config, env, demonstrations))
    pieces, num_seeds = pieces_of(parts), setting.num_seeds
    keys = jax.random.split(jax.random.key(setting.seed), num_seeds)
    state = spread(functools.partial(on_policy.init, parts), num_seeds)(keys)
    _, transition = spread(pieces.act, num_seeds)(state, keys)
    samples = spread(pieces.score, num_seeds)(state, transition)
    held_out, training = spread(pieces.split, num_seeds)(samples, keys)
    _, taken, _ = spread(pieces.improve, num_seeds)(state, training, held_out)
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

    return {
        PHYSICS: physics_work(env, setting),
        "environment": work(pieces.walk, batch, state, actions),
        "rollout": work(pieces.act, batch, state, keys),
        "reward, values, advantages": work(pieces.score, batch, state, transition),
        "policy step": work(pieces.improve, batch, state, training, held_out),
        "critics": work(pieces.fit, batch, state, training, keys),
        "discriminator": work(pieces.discriminate, iteration, state, transition, keys),
        "multiplier": work(pieces.constrain, iteration, state, taken),
        "training": training_work(config, env, setting)[0],
    }


def profile(setting: Setting) -> dict[str, Any]:
    """Measures the microseconds per environment step of each part, and their ratios to those of physics alone.

    Times are divided by the environment steps of all seeds together. In every round each part is measured once; ratios
    are taken within a round, and medians over the rounds are returned. `environment` steps under random actions, as
    `physics alone` does; all other parts work on data from the policy of an untrained learner.
    """
    env: Any = envs.make(setting.task, physics=setting.physics)
    timed = works(setting, env)
    for run in timed.values():
        run()  # compiles, and warms caches
    times = {name: np.zeros(setting.rounds) for name in timed}
    for i in range(setting.rounds):
        for name, run in timed.items():
            times[name][i] = 1e6 / rate_of(run, setting.seconds)
    return {
        "task": setting.task,
        "physics": physics_name(env),
        "method": setting.method,
        "num_seeds": setting.num_seeds,
        "num_envs": setting.num_envs,
        "parts": {
            name: {
                "microseconds_per_step": float(np.median(values)),
                "to_physics": float(np.median(values / times[PHYSICS])),
            }
            for name, values in times.items()
        },
    }
