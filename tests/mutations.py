"""Mutations that the tests must notice: each is made in a copy of the sources, and the tests named must fail.

    python -m tests.mutations            # a table; status 1 if a mutation survives

Takes some minutes: every mutation compiles its programs anew.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
COPIED = ("ccil_jax", "envs", "experiments", "tests", "pyproject.toml")


class Mutation(NamedTuple):
    """`before`, which must occur once in `file`, becomes `after`."""

    name: str
    file: str
    before: str
    after: str
    tests: tuple[str, ...]  # pytest's arguments


MUTATIONS = (
    Mutation(
        "reward and cost change places in the policy's objectives",
        "ccil_jax/learning/policy_step.py",
        "found = [reward, cost]",
        "found = [cost, reward]",
        ("tests/test_constraints.py",),
    ),
    Mutation(
        "reward and cost change places among the advantages",
        "ccil_jax/agents/on_policy.py",
        "reward_advantage, cost_advantage = advantage[REWARD], advantage[COST]",
        "reward_advantage, cost_advantage = advantage[COST], advantage[REWARD]",
        ("tests/test_episodes.py", "tests/test_probe_envs.py"),
    ),
    Mutation(
        "at a time limit the value is that of the next episode's beginning",
        "ccil_jax/learning/returns.py",
        "(done & ~no_future).at[-1]",
        "jnp.zeros_like(done).at[-1]",
        ("tests/test_returns.py",),
    ),
    Mutation(
        "the batch's last values are followed by its first",
        "ccil_jax/learning/returns.py",
        "(done & ~no_future).at[-1].set(True)",
        "done & ~no_future",
        ("tests/test_returns.py",),
    ),
    Mutation(
        "the discriminator's labels change places",
        "ccil_jax/learning/reward_models.py",
        "loss = jnp.mean(jax.nn.softplus(-expert_logits)) + jnp.mean(jax.nn.softplus(learner_logits))",
        "loss = jnp.mean(jax.nn.softplus(expert_logits)) + jnp.mean(jax.nn.softplus(-learner_logits))",
        ("tests/test_reward_models.py",),
    ),
    Mutation(
        "the reward grows where the learner is recognised",
        "ccil_jax/learning/reward_models.py",
        '"softplus": jax.nn.softplus,',
        '"softplus": lambda logits: jax.nn.softplus(-logits),',
        ("tests/test_reward_models.py",),
    ),
    Mutation(
        "the indirect term of the meta-gradient is dropped",
        "ccil_jax/learning/constraints.py",
        "return jax.jvp(loss, (multiplier, after_dual), (one, tangent))[1]",
        "return jax.jvp(loss, (multiplier, after_dual), (jnp.zeros_like(one), tangent))[1]",
        ("tests/test_meta_gradient.py",),
    ),
    Mutation(
        "the direct term of the meta-gradient is dropped",
        "ccil_jax/learning/constraints.py",
        'tangent = one if kind == "full" else jnp.zeros_like(after_dual)',
        "tangent = jnp.zeros_like(after_dual)",
        ("tests/test_meta_gradient.py",),
    ),
    Mutation(
        "the outer step ascends its loss",
        "ccil_jax/learning/constraints.py",
        "write(read(state) - config.meta_learning_rate * gradient)",
        "write(read(state) + config.meta_learning_rate * gradient)",
        ("tests/test_meta_gradient.py", "tests/test_constraints.py"),
    ),
    Mutation(
        "the dual step descends",
        "ccil_jax/learning/constraints.py",
        "updates, optimizer_state = optimizer.update(-cost_gap, state.optimizer)",
        "updates, optimizer_state = optimizer.update(cost_gap, state.optimizer)",
        ("tests/test_constraints.py",),
    ),
    Mutation(
        "the cost is rewarded",
        "ccil_jax/learning/constraints.py",
        "return jnp.stack([jnp.ones_like(multiplier), -multiplier])",
        "return jnp.stack([jnp.ones_like(multiplier), multiplier])",
        ("tests/test_constraints.py",),
    ),
    Mutation(
        "CVAG's gate is inverted",
        "ccil_jax/learning/constraints.py",
        "return jnp.where(step_gap <= 0, jnp.array([1.0, 0.0]), jnp.array([0.0, -1.0]))",
        "return jnp.where(step_gap > 0, jnp.array([1.0, 0.0]), jnp.array([0.0, -1.0]))",
        ("tests/test_constraints.py",),
    ),
    Mutation(
        "the optimal multiplier takes the gap's other sign",
        "ccil_jax/learning/multipliers.py",
        "nu = jnp.maximum((r + inverse_scale * gap) / safe_s, 0.0)",
        "nu = jnp.maximum((r - inverse_scale * gap) / safe_s, 0.0)",
        ("tests/test_multipliers.py",),
    ),
    Mutation(
        "the PID controller's integral is not clipped",
        "ccil_jax/learning/multipliers.py",
        "integral = jnp.clip(state.integral + gains.integral * error, 0.0, maximum)",
        "integral = state.integral + gains.integral * error",
        ("tests/test_multipliers.py",),
    ),
    Mutation(
        "a time limit counts as the task's end",
        "ccil_jax/agents/on_policy.py",
        "no_future = transition.terminated if config.bootstrap_at_truncation else transition.done",
        "no_future = transition.done",
        ("tests/test_episodes.py", "tests/test_probe_envs.py"),
    ),
    Mutation(
        "importance weights are left out of the policy's objectives",
        "ccil_jax/learning/policy_step.py",
        "reward = jnp.mean(weights * batch.reward_advantage) + bonus",
        "reward = jnp.mean(jax.lax.stop_gradient(weights) * batch.reward_advantage) + bonus",
        ("tests/test_constraints.py", "tests/test_meta_gradient.py"),
    ),
    Mutation(
        "the step is not scaled to the trust region",
        "ccil_jax/learning/trust_region.py",
        "jnp.sqrt(2 * max_kl / jnp.where(moves, q, 1.0))",
        "jnp.sqrt(max_kl / jnp.where(moves, q, 1.0))",
        ("tests/test_trust_region.py",),
    ),
    Mutation(
        "a reset hides the true successor",
        "ccil_jax/acting/rollout.py",
        "transition = _transition(state, action, stepped)",
        "seen = dataclasses.replace(stepped, obs=jax.vmap(reset_if_done)(stepped, reset_keys).obs)"
        "; transition = _transition(state, action, seen)",
        ("tests/test_episodes.py",),
    ),
    Mutation(
        "IQ-Learn bootstraps beyond the end of the task",
        "ccil_jax/agents/iq_learn.py",
        "target = (1 - batch.terminated) * config.gamma * next_value",
        "target = config.gamma * next_value",
        ("tests/test_iq_learn.py",),
    ),
    Mutation(
        "IQ-Learn lowers the expert's reward",
        "ccil_jax/agents/iq_learn.py",
        "return value_term - on_expert + ",
        "return value_term + on_expert + ",
        ("tests/test_iq_learn.py",),
    ),
    Mutation(
        "behaviour cloning keeps its last parameters",
        "ccil_jax/agents/behavior_cloning.py",
        "jnp.where(held_out <= bar, new, old)",
        "jnp.where(held_out <= jnp.inf, new, old)",
        ("tests/test_behavior_cloning.py",),
    ),
    Mutation(
        "an action at a bound has the density of one inside",
        "ccil_jax/acting/distributions.py",
        "at_bound = (action <= low) | (action >= high)",
        "at_bound = (action < low) | (action > high)",
        ("tests/test_distributions.py",),
    ),
    Mutation(
        "the clone moves while it should be held",
        "ccil_jax/agents/on_policy.py",
        "warming_up = state.iteration < config.warmup_iterations",
        "warming_up = state.iteration < 0",
        ("tests/test_cloning.py",),
    ),
    Mutation(
        "a replayed step leaves the demonstrations out",
        "ccil_jax/learning/policy_step.py",
        "weights = _weights(config, constraint, multiplier, taken.step_gap, taken.directions.gram)",
        "weights = _weights(config, constraint, multiplier, taken.step_gap, taken.directions.gram).at[2:].set(0.0)",
        ("tests/test_cloning.py",),
    ),
    Mutation(
        "the cost counts as a reward in the Lagrangian outer loss",
        "ccil_jax/learning/constraints.py",
        "reward_advantage - weight * cost_advantage",
        "reward_advantage + weight * cost_advantage",
        ("tests/test_meta_gradient.py",),
    ),
)


def kill(mutation: Mutation, folder: Path) -> str | None:
    """The first test that fails on the mutated copy in `folder`; None if none does."""
    file = folder / mutation.file
    source = file.read_text(encoding="utf-8")
    assert source.count(mutation.before) == 1, f"{mutation.file}: {mutation.before!r} does not occur once"
    file.write_text(source.replace(mutation.before, mutation.after), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *mutation.tests]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    try:
        result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    finally:
        file.write_text(source, encoding="utf-8")
    failed = [line.split()[1] for line in result.stdout.splitlines() if line.startswith("FAILED")]
    assert failed or result.returncode == 0, result.stdout[-2000:] + result.stderr[-2000:]
    return failed[0] if failed else None


def main() -> int:
    """Makes every mutation and prints what killed it."""
    survivors = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for entry in COPIED:
            source = ROOT / entry
            if source.is_dir():
                shutil.copytree(source, folder / entry, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, folder / entry)
        for mutation in MUTATIONS:
            start = time.perf_counter()
            killer = kill(mutation, folder)
            survivors += killer is None
            seconds = time.perf_counter() - start
            print(
                f"{'SURVIVED' if killer is None else 'killed':8}  {seconds:4.0f} s  {mutation.name}: {killer}",
                flush=True,
            )
    print(f"{len(MUTATIONS) - survivors} of {len(MUTATIONS)} mutations killed")
    return int(survivors > 0)


if __name__ == "__main__":
    sys.exit(main())
