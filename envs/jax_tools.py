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
    """`compute(*args)` where `needed` [] bool, else `otherwise`: for what is dear and rarely needed, as a reset.

    Vmapped, it computes only when some simulation of the batch needs it, while `lax.cond` would at every step.
    """

    def turn(carry: tuple[jax.Array, Tree]) -> tuple[jax.Array, Tree]:
        # The barrier ties the arguments to this turn: XLA moves out of a loop what depends on nothing in it. Keys pass
        # it as plain numbers: JAX's check of key reuse does not know that the loop turns once.
        needed, bound = jax.lax.optimization_barrier((carry[0], jax.tree.map(numbers, args)))
        return jnp.zeros_like(needed), compute(*jax.tree.map(as_before, args, bound))

    return jax.lax.while_loop(lambda carry: carry[0], turn, (needed, otherwise))[1]


def scan(turn: Callable[[Carry, Inputs], tuple[Carry, Outputs]], carry: Carry, inputs: Inputs) -> tuple[Carry, Outputs]:
    """`jax.lax.scan`, for inputs among which there are random keys.

    Vmapped, a scan moves the axis that it goes along to the front, and JAX's check of key reuse takes a key whose axes
    were moved for a used one. So keys are handed to the loop as plain numbers, and are keys again in each turn.
    """

    def plain_turn(carry: Carry, plain: PyTree) -> tuple[Carry, Outputs]:
        return turn(carry, jax.tree.map(as_before, inputs, plain))

    return jax.lax.scan(plain_turn, carry, jax.tree.map(numbers, inputs))


def numbers(leaf: jax.Array) -> jax.Array:
    """The leaf itself, or the numbers behind a random key."""
    return jax.random.key_data(leaf) if is_key(leaf) else leaf


def as_before(leaf: jax.Array, plain: jax.Array) -> jax.Array:
    """What `numbers` made of a leaf like `leaf`, as it was: a random key where `leaf` is one."""
    return jax.random.wrap_key_data(plain, impl=jax.random.key_impl(leaf)) if is_key(leaf) else plain


def is_key(leaf: Any) -> bool:
    """Whether these are random keys, not numbers."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
