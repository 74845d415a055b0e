"""Protection against NaN and infinity: an iteration that yields them is taken back; a seed with many of them stops.

This is a wrapper around an agent's functions for one seed. The seeds are vmapped around the wrapper, so a fault of one
seed does not change the bits of the others.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from ccil_jax.acting.rollout import Actor
from ccil_jax.agents.base import Agent
from ccil_jax.types import Metrics, PyTree
from envs.jax_tools import compute_where, is_key

# The field of an environment's state that may hold infinities: with MJX they mark contacts that are not there. A fault
# in it that matters shows in the observation.
UNCHECKED = "physics"


@struct.dataclass(kw_only=True)
class GuardedState:
    """An agent's state, and how many iterations were taken back."""

    agent: Any  # the agent's own state
    skipped: jax.Array  # [] int32: number of iterations taken back so far
    skipped_in_a_row: jax.Array  # [] int32: number of them since the last sound one; at the limit the seed has stopped

    @property
    def actor(self) -> Actor:
        """The agent's policy and observation statistics."""
        return self.agent.actor


def protect(agent: Agent, max_skipped: int) -> Agent:
    """The same agent, but every step that is not sound is taken back.

    A step is sound if all its metrics are finite, and every number of the state that was finite before is so after.
    Taking a step back restores the state from before it, bit for bit, except for the random keys: with those from after
    the step, the next step draws other episodes, and may be sound.

    After `max_skipped` steps in a row that were taken back, the seed stops. Its state, with the random keys, is the one
    from before the last of these steps, so `agent.step` of it repeats the fault. The metric `skipped_updates` counts
    the steps that were taken back.

    Args:
        agent: of one seed; vmap the result.
        max_skipped: at this many steps in a row the seed stops.
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

        # `compute_where` computes nothing while every seed is sound, which is nearly always. It also keeps XLA from
        # fusing the selection below into the step: fused, the step would round differently from an unguarded one.
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
    """[] bool: whether every number that was finite before is so after; `UNCHECKED` fields are left aside."""

    def stays(path: tuple[Any, ...], before: jax.Array, after: jax.Array) -> jax.Array:
        if not _is_float(before) or any(getattr(entry, "name", None) == UNCHECKED for entry in path):
            return jnp.asarray(True)
        return jnp.all(jnp.isfinite(after) | ~jnp.isfinite(before))

    checks = jax.tree_util.tree_map_with_path(stays, before, after)
    return jnp.asarray(jax.tree.leaves(checks)).all()


def stopped(state: GuardedState, max_skipped: int) -> jax.Array:
    """[S] bool: which seeds have stopped, in the state of S seeds."""
    return state.skipped_in_a_row >= max_skipped


def not_finite(tree: PyTree) -> list[str]:
    """The names of the leaves of a tree that hold NaN or infinity."""
    found = jax.tree_util.tree_leaves_with_path(tree)
    return [
        jax.tree_util.keystr(path, simple=True, separator=".")
        for path, leaf in found
        if _is_float(leaf) and not bool(jnp.all(jnp.isfinite(leaf)))
    ]


def _is_float(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)
