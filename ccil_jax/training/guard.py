"""Numbers that go wrong: an iteration that is not finite does not happen, and a seed that cannot recover stops.

A wrapper around an agent's step. Seeds are vmapped from outside, so what befalls one leaves the others' bits alone.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from ccil_jax.acting.rollout import Actor
from ccil_jax.agents.base import Agent
from ccil_jax.types import Metrics, PyTree
from envs.jax_tools import compute_where, is_key

# An engine's own state may hold infinities (MJX marks absent contacts so). What of it matters shows in the observation.
UNCHECKED = "physics"


@struct.dataclass(kw_only=True)
class GuardedState:
    """An agent's state with its faults counted."""

    agent: Any
    skipped: jax.Array  # [] int32: iterations that were not finite, so far
    skipped_in_a_row: jax.Array  # [] int32: of them, those since the last finite one; at the limit the seed has stopped

    @property
    def actor(self) -> Actor:
        """The agent's policy and observation statistics."""
        return self.agent.actor


def protect(agent: Agent, max_skipped: int) -> Agent:
    """The same agent, with every step that is not finite taken back.

    A step is not finite where a metric is not, or where a number of the state was finite before and is not after.
    Taken back means that everything is as before, bit for bit, but the random keys: the next step rolls other episodes.
    After `max_skipped` such steps in a row the seed stops in the state, with the key, that leads to the last of them:
    `agent.step` replays the fault. The metric `skipped_updates` counts them.
    """

    def init(key: jax.Array) -> GuardedState:
        zero = jnp.zeros((), jnp.int32)
        return GuardedState(agent=agent.init(key), skipped=zero, skipped_in_a_row=zero)

    def step(state: GuardedState) -> tuple[GuardedState, Metrics]:
        old = state.agent
        new, metrics = agent.step(old)
        alive = state.skipped_in_a_row < max_skipped
        ok = all_finite(metrics) & stays_finite(old, new)
        fault = alive & ~ok
        in_a_row = jnp.where(alive & ok, 0, state.skipped_in_a_row + fault.astype(jnp.int32))

        def take_back(old: PyTree, new: PyTree) -> PyTree:
            keys = jax.tree.map(lambda before, after: after if is_key(before) else before, old, new)
            return jax.tree.map(lambda a, b: jnp.where(in_a_row < max_skipped, a, b), keys, old)

        # Almost never needed, so nothing is copied; and a step that no code follows rounds as it does unguarded.
        held = compute_where(~(alive & ok), take_back, new, old, new)
        skipped = state.skipped + fault.astype(jnp.int32)
        guarded = GuardedState(agent=held, skipped=skipped, skipped_in_a_row=in_a_row)
        return guarded, metrics | {"skipped_updates": skipped}

    return agent._replace(init=init, step=step)


def all_finite(tree: PyTree) -> jax.Array:
    """[] bool: whether every floating-point number in `tree` is finite."""
    leaves = [leaf for leaf in map(jnp.asarray, jax.tree.leaves(tree)) if _is_float(leaf)]
    return jnp.asarray([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]).all()


def stays_finite(before: PyTree, after: PyTree) -> jax.Array:
    """[] bool: whether every number that was finite still is, an engine's own state aside."""

    def stays(path: tuple[Any, ...], before: jax.Array, after: jax.Array) -> jax.Array:
        if not _is_float(before) or any(getattr(entry, "name", None) == UNCHECKED for entry in path):
            return jnp.asarray(True)
        return jnp.all(jnp.isfinite(after) | ~jnp.isfinite(before))

    checks = jax.tree_util.tree_map_with_path(stays, before, after)
    return jnp.asarray(jax.tree.leaves(checks)).all()


def stopped(state: GuardedState, max_skipped: int) -> jax.Array:
    """[S] bool: the seeds that have stopped, of an [S]-leading state."""
    return state.skipped_in_a_row >= max_skipped


def not_finite(tree: PyTree) -> list[str]:
    """Names of the leaves that hold NaN or infinity."""
    found = jax.tree_util.tree_leaves_with_path(tree)
    return [
        jax.tree_util.keystr(path, simple=True, separator=".")
        for path, leaf in found
        if _is_float(leaf) and not bool(jnp.all(jnp.isfinite(leaf)))
    ]


def _is_float(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)
