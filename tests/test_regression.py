"""Critic regression: what it learns, and which samples each of its gradient steps sees."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ccil_jax.learning import regression
from ccil_jax.learning.regression import Critic

BETA = 0.9  # of Adam's first moment


def fit(obs: Any, target: Any, params: Any, **changes: Any) -> tuple[Critic, jax.Array]:
    options: dict[str, Any] = {"learning_rate": 0.0, "num_epochs": 1, "minibatch_size": 4} | changes
    critic = regression.init(jnp.asarray(params), options["learning_rate"])
    key = jax.random.key(options.pop("seed", 0))

    def apply(params: jax.Array, obs: jax.Array) -> jax.Array:
        return obs @ params

    return regression.fit(apply, critic, jnp.asarray(obs), jnp.asarray(target), key, **options)


def test_recovers_a_linear_function() -> None:
    rng = np.random.default_rng(0)
    obs, truth = rng.normal(size=(130, 3)).astype(np.float32), np.array([1.0, -2.0, 0.5], np.float32)
    critic, loss = fit(obs, obs @ truth, np.zeros(3, np.float32), learning_rate=0.03, num_epochs=60, minibatch_size=16)
    np.testing.assert_allclose(critic.params, truth, atol=1e-3)
    assert loss < 1e-5


def steps_since_seen(num_samples: int, minibatch_size: int, seed: int) -> np.ndarray:
    """For one epoch: how many gradient steps followed the one that saw each sample; NaN if none did.

    Sample i has observation e_i and target 1, parameters stay 0, so only a step that sees i has a gradient in entry
    i, -2 / minibatch_size, and Adam's first moment remembers when: (1 - BETA) BETA^(steps since) times it.
    """
    eye = np.eye(num_samples, dtype=np.float32)
    critic, _ = fit(eye, np.ones(num_samples, np.float32), eye[0] * 0, minibatch_size=minibatch_size, seed=seed)
    moment = np.asarray(critic.optimizer[0].mu) / (-2 / minibatch_size * (1 - BETA))
    with np.errstate(divide="ignore"):
        steps = np.log(moment) / np.log(BETA)
    return np.where(moment == 0, np.nan, steps)


def test_an_epoch_shows_every_sample_exactly_once_in_full_minibatches() -> None:
    steps = steps_since_seen(12, 4, seed=0)
    np.testing.assert_allclose(np.sort(steps), np.repeat([0, 1, 2], 4), atol=1e-4)
    assert not np.allclose(steps, steps_since_seen(12, 4, seed=1))  # in a random order


def test_the_last_partial_minibatch_is_dropped() -> None:
    steps = steps_since_seen(11, 4, seed=0)
    assert np.isnan(steps).sum() == 3
    np.testing.assert_allclose(np.sort(steps[~np.isnan(steps)]), np.repeat([0, 1], 4), atol=1e-4)


def test_epochs_are_shuffled_anew() -> None:
    eye = np.eye(12, dtype=np.float32)
    critic, _ = fit(eye, np.ones(12, np.float32), eye[0] * 0, num_epochs=2)
    moment = np.asarray(critic.optimizer[0].mu) / (-2 / 4 * (1 - BETA))
    # A sample seen j steps before the end of one epoch and k before the end of the other, 3 steps to an epoch.
    sums = {BETA ** (3 + j) + BETA**k for j in range(3) for k in range(3)}
    assert all(min(abs(m - s) for s in sums) < 1e-5 for m in moment)
    assert any(min(abs(m - BETA ** (3 + j) - BETA**j) for j in range(3)) > 1e-4 for m in moment)  # not the same order
    assert critic.optimizer[0].count == 6


def test_the_loss_is_the_mean_square_error_of_the_last_epoch() -> None:
    rng = np.random.default_rng(0)
    obs, target, params = rng.normal(size=(8, 2)), rng.normal(size=8), np.array([0.3, -0.1])
    _, loss = fit(obs.astype(np.float32), target.astype(np.float32), params.astype(np.float32), num_epochs=2)
    np.testing.assert_allclose(loss, np.mean((obs @ params - target) ** 2), rtol=1e-5)


def test_a_network_that_returns_a_column_is_refused() -> None:
    """[M, 1] less [M] would be [M, M] without an error."""
    obs, target = np.ones((8, 2), np.float32), np.ones(8, np.float32)
    with pytest.raises(AssertionError, match=r"\(4, 1\)"):
        fit(obs, target, np.ones((2, 1), np.float32))
    with pytest.raises(AssertionError, match=r"\(8, 1\)"):
        fit(obs, target[:, None], np.ones(2, np.float32))


def test_an_optimizer_may_use_the_parameters() -> None:
    """Decoupled weight decay: with targets that are met, parameters shrink by the learning rate times the decay."""

    def decaying(learning_rate: Any) -> optax.GradientTransformation:
        return optax.adamw(learning_rate, weight_decay=0.5)

    critic = regression.init(jnp.ones(1), 0.1, decaying)
    found, _ = regression.fit(
        lambda params, obs: 0 * params[0] + obs[:, 0],
        critic,
        jnp.ones((4, 1)),
        jnp.ones(4),
        jax.random.key(0),
        learning_rate=0.1,
        num_epochs=1,
        minibatch_size=4,
        optimizer=decaying,
    )
    np.testing.assert_allclose(found.params, [0.95], rtol=1e-6)


def test_a_normalized_critic_learns_what_a_plain_one_does_of_targets_by_hand() -> None:
    """Two fits: the second has the mean and the deviation of the targets of both."""
    rng = np.random.default_rng(0)
    obs, key = jnp.asarray(rng.normal(size=(40, 3)), jnp.float32), jax.random.key(0)
    first, second = 300 + 50 * rng.normal(size=(2, 40)).astype(np.float32)
    options: dict[str, Any] = {"learning_rate": 0.01, "num_epochs": 3, "minibatch_size": 8}

    def apply(params: jax.Array, obs: jax.Array) -> jax.Array:
        return obs @ params

    normalized: Critic = regression.init_normalized(jnp.zeros(3), 0.01)
    plain = regression.init(jnp.zeros(3), 0.01)
    seen = np.zeros(0)
    for target in (first, second):
        seen = np.append(seen, target)
        by_hand = jnp.asarray((target - seen.mean()) / seen.std(), jnp.float32)
        plain, plain_loss = regression.fit(apply, plain, obs, by_hand, key, **options)
        normalized, loss = regression.fit(apply, normalized, obs, jnp.asarray(target), key, **options)
        np.testing.assert_allclose(normalized.params, plain.params, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(loss, plain_loss * seen.var(), rtol=1e-4)
        values = regression.predict(apply, normalized, obs)
        np.testing.assert_allclose(values, seen.mean() + seen.std() * apply(plain.params, obs), rtol=1e-4)


def test_before_its_first_fit_a_normalized_critic_is_its_network() -> None:
    critic = regression.init_normalized(jnp.arange(3.0), 0.01)
    obs = jnp.ones((2, 3))
    np.testing.assert_array_equal(regression.predict(lambda params, obs: obs @ params, critic, obs), [3.0, 3.0])
