"""Adam, as every part of the package that follows gradients uses it."""

from collections.abc import Callable

import optax
from jaxtyping import Array, Float

from envs.jax_tools import usual_rules

Optimizer = Callable[[Float[Array, ""] | float], optax.GradientTransformation]  # learning rate -> update rule


def adam(learning_rate: Float[Array, ""] | float) -> optax.GradientTransformation:
    """Optax's Adam, which also runs where JAX is told to refuse arithmetic between types (`numpy_dtype_promotion`).

    Optax raises decay rates to the power of an integer counter, so its own code is traced under the usual rules.
    """
    inner = optax.adam(learning_rate)
    return optax.GradientTransformation(inner.init, usual_rules(inner.update))
