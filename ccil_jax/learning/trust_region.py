"""The trust-region policy step (Schulman et al. 2015) for a weighted sum of objectives.

Nothing here is particular to rewards or costs. From the gradients g_i of R objectives it finds their natural directions
x_i = F^-1 g_i, F the damped Fisher matrix, all R together. Then it moves along any weighted sum of them. The directions
do not depend on the weights, so the step is a closed-form function of the weights: differentiating it with respect to
them (for a meta-gradient) needs no derivative of conjugate gradients.
"""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from ccil_jax.acting import distributions
from ccil_jax.acting.distributions import CensoredGaussian, Gaussian
from ccil_jax.types import Metrics

Vectors = Float[Array, "R P"]


@struct.dataclass(kw_only=True)
class Directions:
    """Natural gradients of R objectives and their inner products under the damped Fisher matrix F."""

    x: jax.Array  # [R, P] x_i, approximately F^-1 g_i
    gram: jax.Array  # [R, R] the Gram matrix x_i . F x_j


def fisher_vector_product(
    distribution: Callable[[jax.Array], Gaussian | CensoredGaussian],
    params: Float[Array, " P"],
    damping: Float[Array, ""] | float,
) -> Callable[[Vectors], Vectors]:
    """The function that multiplies each of R vectors by F + damping I.

    F is the Fisher matrix of the parameters, averaged over the samples of `distribution(params)`, in its Gauss-Newton
    form J^T M J: J is the Jacobian of (mean, log_std) and M the Fisher matrix in these coordinates. J is found once, by
    linearisation, and used by every product.
    """
    at, push = jax.linearize(lambda params: distributions.gaussian_of(distribution(params)), params)
    pull = jax.linear_transpose(push, params)
    num_samples = at.mean.shape[0]

    def product(vector: jax.Array) -> jax.Array:
        image = distributions.fisher_product(at, push(vector))
        (pulled,) = pull(Gaussian(mean=image.mean / num_samples, log_std=image.log_std))
        return pulled + damping * vector

    return jax.vmap(product)


class Solve(NamedTuple):
    """Conjugate gradients between two iterations, for R right-hand sides."""

    x: jax.Array  # [R, P]
    residual: jax.Array  # [R, P]
    direction: jax.Array  # [R, P] the search direction
    squared_residual: jax.Array  # [R]


def conjugate_gradient(
    product: Callable[[Vectors], Vectors], b: Vectors, num_iterations: int, tolerance: float = 1e-10
) -> tuple[Vectors, Vectors]:
    """Solves A x = b for R right-hand sides at once; `product` applies the positive definite A to R vectors.

    A right-hand side is finished, and its x stays as it is, once its squared residual is below `tolerance` times |b|^2
    or the curvature along its search direction is not positive.

    Returns:
        x and the residual b - A x, as the recurrence of conjugate gradients gives it.
    """
    target = tolerance * jnp.sum(b * b, axis=-1)

    def iterate(solve: Solve, _: None) -> tuple[Solve, None]:
        x, residual, direction, squared = solve
        image = product(direction)
        chex.assert_equal_shape([direction, image])
        curvature = jnp.sum(direction * image, axis=-1)
        active = (squared > target) & (curvature > 0)
        alpha = jnp.where(active, squared / jnp.where(active, curvature, 1.0), 0.0)[:, None]
        x = x + alpha * direction
        residual = residual - alpha * image
        new_squared = jnp.sum(residual * residual, axis=-1)
        beta = jnp.where(active, new_squared / jnp.where(active, squared, 1.0), 0.0)[:, None]
        direction = jnp.where(active[:, None], residual + beta * direction, direction)
        return Solve(x, residual, direction, jnp.where(active, new_squared, squared)), None

    start = Solve(jnp.zeros_like(b), residual=b, direction=b, squared_residual=jnp.sum(b * b, axis=-1))
    solve, _ = jax.lax.scan(iterate, start, None, length=num_iterations)
    return solve.x, solve.residual


def directions(product: Callable[[jax.Array], jax.Array], gradients: jax.Array, num_iterations: int) -> Directions:
    """Natural directions of R gradients and their Gram matrix.

    F x = g - residual. So the Gram matrix is exact for the x that was found, however few iterations there were, and it
    costs no further Fisher product.

    Args:
        product: multiplies each of R vectors [R, P] by F, see `fisher_vector_product`.
        gradients: [R, P].
        num_iterations: of conjugate gradients.

    Raises:
        AssertionError: the gradients are no matrix, or `product` does not keep their shape.
    """
    chex.assert_rank(gradients, 2)
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
    """params + fraction sqrt(2 max_kl / q) w.x, with q = w.Gram.w: a differentiable function of `weights` w.

    To second order, the full step (fraction 1) has a KL divergence of `max_kl`. Where the weighted directions cancel
    (q is not clearly positive), the step is zero.
    """
    q = weights @ along.gram @ weights
    uncancelled = jnp.sum(weights**2 * jnp.diagonal(along.gram))
    moves = q > 1e-7 * uncancelled
    scale = jnp.where(moves, jnp.sqrt(2 * max_kl / jnp.where(moves, q, 1.0)), 0.0)
    return params + fraction * scale * (weights @ along.x)


class Candidate(NamedTuple):
    """Parameters that the line search tries."""

    params: jax.Array  # [P]
    gain: jax.Array  # [] by how much the weighted objective is larger than at theta_k
    kl: jax.Array  # [] mean KL divergence from theta_k, nats

    @property
    def is_finite(self) -> jax.Array:
        """[] bool: neither the parameters nor what was found for them is NaN or infinite."""
        return jnp.isfinite(self.gain) & jnp.isfinite(self.kl) & jnp.all(jnp.isfinite(self.params))


class Search(NamedTuple):
    """The line search after a number of candidates."""

    tried: jax.Array  # [] int32: number of candidates so far
    last: Candidate
    accepted: jax.Array  # [] bool: whether the last one is


def step(
    params: jax.Array,
    along: Directions,
    weights: jax.Array,
    evaluate: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    *,
    max_kl: Float[Array, ""] | float,
    kl_tolerance: Float[Array, ""] | float,
    num_halvings: int,
) -> tuple[jax.Array, jax.Array, Metrics]:
    """Backtracking line search along the weighted direction.

    Args:
        params: theta_k [P], flat.
        along: the natural directions at theta_k.
        weights: [R], how the R objectives combine; their weighted sum is to be increased.
        evaluate: candidate parameters [P] -> (the R objectives [R], mean KL divergence from theta_k []).
        max_kl: radius that the full step aims at, nats.
        kl_tolerance: a candidate is accepted up to a KL divergence of `kl_tolerance * max_kl`.
        num_halvings: how many candidates are tried at most, at fractions 1, 1/2, 1/4, ... of the full step.

    Returns:
        The parameters after the step: the first candidate that is finite, within the radius and no worse than theta_k.
        Where there is none, they are `params` bit for bit.
        The fraction of the full step, 0 where there is no step.
        Metrics: `kl`, `surrogate` (by how much the weighted objective has increased), `step_fraction`, and four of
        which one is 1 where there is no step, to say why. `rejected_not_finite`, `rejected_by_kl` and
        `rejected_by_surrogate` tell what was wrong with the last candidate; `no_direction` that the weighted directions
        cancel.

    Raises:
        AssertionError: the shapes do not fit, also those of what `evaluate` returns.
    """
    chex.assert_shape([along.x, along.gram], [(*weights.shape, *params.shape), weights.shape * 2])

    def objective(params: jax.Array) -> tuple[jax.Array, jax.Array]:
        objectives, kl = evaluate(params)
        chex.assert_shape([objectives, kl], [weights.shape, ()])
        return weights @ objectives, kl

    def halved(times: jax.Array) -> jax.Array:
        return jax.lax.pow(jnp.asarray(0.5, params.dtype), times)

    def proposal(times: jax.Array) -> jax.Array:
        return propose(params, along, weights, max_kl, halved(times))

    search = _line_search(params, proposal, objective, kl_tolerance * max_kl, num_halvings)
    # Where the directions cancel, the candidate is theta_k itself: it is accepted, but it counts as no step.
    moved = search.accepted & jnp.any(search.last.params != params)
    fraction = jnp.where(moved, halved(search.tried - 1), 0.0)
    metrics = {
        **_reasons(search, moved, kl_tolerance * max_kl),
        "kl": jnp.where(search.accepted, search.last.kl, 0.0),
        "surrogate": jnp.where(search.accepted, search.last.gain, 0.0),
        "step_fraction": fraction,
    }
    return jnp.where(search.accepted, search.last.params, params), fraction, metrics


def _line_search(
    params: jax.Array,
    proposal: Callable[[jax.Array], jax.Array],
    objective: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    largest_kl: Float[Array, ""] | float,
    num_halvings: int,
) -> Search:
    """Tries the parameters `proposal(0)`, `proposal(1)`, ... until one is accepted; `objective` judges them."""
    before, _ = objective(params)

    def unfinished(search: Search) -> jax.Array:
        return ~search.accepted & (search.tried < num_halvings)

    def attempt(search: Search) -> Search:
        proposed = proposal(search.tried)
        after, kl = objective(proposed)
        candidate = Candidate(params=proposed, gain=after - before, kl=kl)
        accepted = candidate.is_finite & (candidate.kl <= largest_kl) & (candidate.gain >= 0)
        return Search(tried=search.tried + 1, last=candidate, accepted=accepted)

    zero = jnp.zeros((), params.dtype)
    start = Search(jnp.zeros((), jnp.int32), Candidate(params, gain=zero, kl=zero), accepted=jnp.zeros((), bool))
    return jax.lax.while_loop(unfinished, attempt, start)


def _reasons(search: Search, moved: jax.Array, largest_kl: Float[Array, ""] | float) -> Metrics:
    """Why there was no step, as numbers 0 and 1."""
    finite, within_radius = search.last.is_finite, search.last.kl <= largest_kl
    reasons = {
        "rejected_not_finite": ~search.accepted & ~finite,
        "rejected_by_kl": ~search.accepted & finite & ~within_radius,
        "rejected_by_surrogate": ~search.accepted & finite & within_radius,
        "no_direction": search.accepted & ~moved,
    }
    return {name: jnp.asarray(reason, search.last.params.dtype) for name, reason in reasons.items()}
