"""Adam, the optimiser of every part of the package that is trained by gradients, unless a user gives another."""

from collections.abc import Callable

import optax
from jaxtyping import Array, Float

from envs.jax_tools import usual_rules

Optimizer = Callable[[Float[Array, ""] | float], optax.GradientTransformation]  # learning rate -> update rule


def adam(learning_rate: Float[Array, ""] | float) -> optax.GradientTransformation:
    """Optax's Adam, in a form that also works under JAX's strict mode for types (`numpy_dtype_promotion="strict"`).

    Strict mode refuses arithmetic between floats and integers. Optax raises decay rates to the power of an integer
    counter, so its update is traced under JAX's usual rules.
    """
    inner = optax.adam(learning_rate)
    return optax.GradientTransformation(inner.init, usual_rules(inner.update))
