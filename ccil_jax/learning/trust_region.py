"""The trust-region policy step (Schulman et al. 2015) for a weighted sum of objectives.

Knows nothing of rewards or costs: it takes R gradients, solves for their R natural directions together, and moves along
any weighted sum of them. As the solves do not depend on the weights, the step is a closed-form function of the
weights, and differentiating it needs no derivative of conjugate gradients.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from ccil_jax.acting import distributions
from ccil_jax.acting.distributions import Gaussian
from ccil_jax.types import Metrics

Vectors = Float[Array, "R P"]
Iterate = tuple[jax.Array, jax.Array, jax.Array, jax.Array]  # x, residual, direction, squared residual
Search = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]  # tries, candidate, gain, kl, accepted


@struct.dataclass(kw_only=True)
class Directions:
    """Natural gradients of R objectives and their inner products under the damped Fisher matrix F."""

    x: jax.Array  # [R, P] approximately F^-1 g
    gram: jax.Array  # [R, R] x_i . F x_j


def fisher_vector_product(
    distribution: Callable[[jax.Array], Gaussian], params: Float[Array, " P"], damping: Float[Array, ""] | float
) -> Callable[[Vectors], Vectors]:
    """The map from R vectors to (F + damping I) times each, F the mean Fisher matrix of `distribution(params)`.

    Gauss-Newton form J^T M J with the distribution's own Fisher matrix M: one linearisation, reused by every product.
    """
    at, push = jax.linearize(distribution, params)
    pull = jax.linear_transpose(push, params)
    num_samples = at.mean.shape[0]

    def product(vector: jax.Array) -> jax.Array:
        image = distributions.fisher_product(at, push(vector))
        (pulled,) = pull(Gaussian(mean=image.mean / num_samples, log_std=image.log_std))
        return pulled + damping * vector

    return jax.vmap(product)


def conjugate_gradient(
    product: Callable[[Vectors], Vectors], b: Vectors, num_iterations: int, tolerance: float = 1e-10
) -> tuple[Vectors, Vectors]:
    """Solves A x = b for R right-hand sides at once; `product` applies the positive definite A to R vectors.

    A right-hand side is frozen once its squared residual is below `tolerance` times |b|^2 or its curvature is not
    positive.

    Returns:
        (x, b - A x), the residual from the recurrence.
    """
    target = tolerance * jnp.sum(b * b, axis=-1)

    def iterate(carry: Iterate, _: None) -> tuple[Iterate, None]:
        x, residual, direction, squared = carry
        image = product(direction)
        curvature = jnp.sum(direction * image, axis=-1)
        active = (squared > target) & (curvature > 0)
        alpha = jnp.where(active, squared / jnp.where(active, curvature, 1.0), 0.0)[:, None]
        x = x + alpha * direction
        residual = residual - alpha * image
        new_squared = jnp.sum(residual * residual, axis=-1)
        beta = jnp.where(active, new_squared / jnp.where(active, squared, 1.0), 0.0)[:, None]
        direction = jnp.where(active[:, None], residual + beta * direction, direction)
        return (x, residual, direction, jnp.where(active, new_squared, squared)), None

    start = (jnp.zeros_like(b), b, b, jnp.sum(b * b, axis=-1))
    (x, residual, _, _), _ = jax.lax.scan(iterate, start, None, length=num_iterations)
    return x, residual


def directions(product: Callable[[Vectors], Vectors], gradients: Vectors, num_iterations: int) -> Directions:
    """Natural directions of R gradients and their Gram matrix.

    F x = g - residual, so the Gram matrix is exact for the truncated x and costs no further Fisher product.
    """
    x, residual = conjugate_gradient(product, gradients, num_iterations)
    gram = x @ (gradients - residual).T
    return Directions(x=x, gram=(gram + gram.T) / 2)


def propose(
    params: Float[Array, " P"],
    along: Directions,
    weights: Float[Array, " R"],
    max_kl: Float[Array, ""] | float,
    fraction: Float[Array, ""] | float,
) -> Float[Array, " P"]:
    """params + fraction sqrt(2 max_kl / q) w.x, with q = w.Gram.w: differentiable in `weights`.

    Where the weighted directions cancel (q not clearly positive) the step is zero.
    """
    q = weights @ along.gram @ weights
    uncancelled = jnp.sum(weights**2 * jnp.diagonal(along.gram))
    moves = q > 1e-7 * uncancelled
    scale = jnp.where(moves, jnp.sqrt(2 * max_kl / jnp.where(moves, q, 1.0)), 0.0)
    return params + fraction * scale * (weights @ along.x)


def step(
    params: Float[Array, " P"],
    along: Directions,
    weights: Float[Array, " R"],
    evaluate: Callable[[jax.Array], tuple[Float[Array, " R"], Float[Array, ""]]],
    *,
    max_kl: Float[Array, ""] | float,
    kl_tolerance: Float[Array, ""] | float,
    num_halvings: int,
) -> tuple[Float[Array, " P"], Float[Array, ""], Metrics]:
    """Backtracking line search along the weighted direction.

    Args:
        params: theta_k, flat.
        along: the natural directions at theta_k.
        weights: how the R objectives combine, all to be increased.
        evaluate: candidate parameters -> (the R objectives, mean KL from theta_k).
        max_kl: radius that the full step aims at.
        kl_tolerance: a candidate is accepted up to `kl_tolerance * max_kl`.
        num_halvings: candidates tried, at fractions 1, 1/2, 1/4, ...

    Returns:
        The first candidate that is finite, within the radius and no worse, or `params` bit for bit; its fraction (0 if
        none, or if the directions cancel); metrics `kl`, `surrogate` (the objective's improvement) and `step_fraction`,
        and why there was no step, one of four that is 1: `rejected_not_finite`, `rejected_by_kl` or
        `rejected_by_surrogate`, by what was wrong with the last candidate, or `no_direction`.
    """
    before = weights @ evaluate(params)[0]

    def finite(candidate: jax.Array, gain: jax.Array, kl: jax.Array) -> jax.Array:
        return jnp.isfinite(gain) & jnp.isfinite(kl) & jnp.all(jnp.isfinite(candidate))

    def halved(times: jax.Array) -> jax.Array:
        return jax.lax.pow(jnp.asarray(0.5, params.dtype), times)

    def within(kl: jax.Array) -> jax.Array:
        return kl <= kl_tolerance * max_kl

    def attempt(index: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        candidate = propose(params, along, weights, max_kl, halved(index))
        objectives, kl = evaluate(candidate)
        gain = weights @ objectives - before
        return candidate, gain, kl, finite(candidate, gain, kl) & within(kl) & (gain >= 0)

    def unfinished(carry: Search) -> jax.Array:
        index, _, _, _, accepted = carry
        return ~accepted & (index < num_halvings)

    def shrink(carry: Search) -> Search:
        index = carry[0]
        return index + 1, *attempt(index)

    zero = jnp.zeros((), params.dtype)
    start = (jnp.zeros((), jnp.int32), params, zero, zero, jnp.zeros((), bool))
    tried, candidate, gain, kl, accepted = jax.lax.while_loop(unfinished, shrink, start)
    # Directions that cancel are accepted as a step of nothing: that counts as no step.
    moved = accepted & jnp.any(candidate != params)
    fraction = jnp.where(moved, halved(tried - 1), 0.0)
    sound = finite(candidate, gain, kl)
    reasons = {
        "rejected_not_finite": ~accepted & ~sound,
        "rejected_by_kl": ~accepted & sound & ~within(kl),
        "rejected_by_surrogate": ~accepted & sound & within(kl),
        "no_direction": accepted & ~moved,
    }
    metrics = {
        **{name: jnp.asarray(reason, params.dtype) for name, reason in reasons.items()},
        "kl": jnp.where(accepted, kl, 0.0),
        "surrogate": jnp.where(accepted, gain, 0.0),
        "step_fraction": fraction,
    }
    return jnp.where(accepted, candidate, params), fraction, metrics
