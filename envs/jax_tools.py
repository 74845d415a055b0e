"""What JAX lacks for loops over vmapped simulations: rare branches, random keys in loops, precision, strict modes."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp

PyTree = Any
Tree = TypeVar("Tree")
Carry = TypeVar("Carry")
Inputs = TypeVar("Inputs")
Outputs = TypeVar("Outputs")
Arguments = ParamSpec("Arguments")


def full_precision(function: Callable[Arguments, Tree]) -> Callable[Arguments, Tree]:
    """`function`, traced so that its products of matrices are of full precision.

    By default NVIDIA's matrix units keep 10 bits of every float32 factor: too few for physics and for curvature. A CPU
    computes the same bits either way.
    """

    @functools.wraps(function)
    def traced(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Tree:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return traced


def usual_rules(function: Callable[Arguments, Tree]) -> Callable[Arguments, Tree]:
    """`function`, traced under JAX's usual rules for mixing types and ranks, whatever is asked of code around it.

    For code of other packages, which a user of JAX's strict modes cannot change.
    """

    @functools.wraps(function)
    def traced(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Tree:
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return traced


def compute_where(needed: jax.Array, compute: Callable[..., Tree], otherwise: Tree, *args: PyTree) -> Tree:
    """`compute(*args)` where `needed` [] bool, else `otherwise`: for what is slow and rarely needed, such as a reset.

    Under vmap `jax.lax.cond` becomes a select: it computes both sides, at every step. This is a loop of at most one
    turn instead, which is skipped when no simulation of the batch needs it.
    """

    def turn(carry: tuple[jax.Array, Tree]) -> tuple[jax.Array, Tree]:
        # XLA moves out of a loop what does not depend on its carry, and would compute at every step after all. The
        # barrier makes the arguments depend on it. Keys pass the barrier as plain numbers, because JAX's check of key
        # reuse does not know that the loop has one turn.
        needed, bound = jax.lax.optimization_barrier((carry[0], jax.tree.map(as_numbers, args)))
        return jnp.zeros_like(needed), compute(*jax.tree.map(as_key_like, args, bound))

    return jax.lax.while_loop(lambda carry: carry[0], turn, (needed, otherwise))[1]


def scan(turn: Callable[[Carry, Inputs], tuple[Carry, Outputs]], carry: Carry, inputs: Inputs) -> tuple[Carry, Outputs]:
    """`jax.lax.scan`, for inputs that contain random keys.

    Under vmap a scan moves its axis to the front, and JAX's check of key reuse counts moving an axis as a use of the
    keys. So the loop gets the numbers behind the keys, and each turn makes keys of them again.
    """

    def plain_turn(carry: Carry, plain: PyTree) -> tuple[Carry, Outputs]:
        return turn(carry, jax.tree.map(as_key_like, inputs, plain))

    return jax.lax.scan(plain_turn, carry, jax.tree.map(as_numbers, inputs))


def as_numbers(leaf: jax.Array) -> jax.Array:
    """The numbers behind a random key; any other array as it is."""
    return jax.random.key_data(leaf) if is_key(leaf) else leaf


def as_key_like(leaf: jax.Array, plain: jax.Array) -> jax.Array:
    """The inverse of `as_numbers`: a random key of these numbers where `leaf` is a key, else `plain` as it is."""
    return jax.random.wrap_key_data(plain, impl=jax.random.key_impl(leaf)) if is_key(leaf) else plain


def is_key(leaf: Any) -> bool:
    """Whether an array holds random keys (JAX's typed keys), not numbers."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
