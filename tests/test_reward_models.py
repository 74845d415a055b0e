"""The discriminator: what it converges to, whose data earns more, and what it is shown."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ccil_jax.acting import networks
from ccil_jax.config import CHOICES, Config
from ccil_jax.learning import reward_models
from ccil_jax.learning.reward_models import Discriminator, RewardModel
from ccil_jax.types import ExpertData, Metrics, Transition
from tests.probe_envs import same_bits, steps_to_judge

pytestmark = pytest.mark.once

LOW, HIGH = np.array([-1.0, -2.0], np.float32), np.array([1.0, 2.0], np.float32)


def transition(obs: Any, action: Any) -> Transition:
    """[T, N] steps of which a reward model reads observations and actions."""
    return steps_to_judge(obs, action, reward=3.0)


def samples(center: float, seed: int, num_steps: int = 16, num_envs: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Observations and actions [T, N, 2] around a centre; the spreads overlap."""
    rng = np.random.default_rng(seed)
    obs, action = rng.normal(center, 1.0, (2, num_steps, num_envs, 2))
    return obs, np.clip(0.5 * action, LOW, HIGH)


def expert_data() -> ExpertData:
    obs, action = (jnp.asarray(x.reshape(-1, 2), jnp.float32) for x in samples(1.0, seed=0))
    return ExpertData(obs=obs[:48], action=action[:48], held_out_obs=obs[48:], held_out_action=action[48:])


def make(expert: ExpertData, **changes: Any) -> RewardModel:
    config = Config(
        hidden_sizes=(8,), discriminator_learning_rate=0.03, batch_size=64, discriminator_minibatch_size=64
    ).replace(**changes)
    network = networks.make_scalar(config, 4)
    return reward_models.discriminator(config, network, expert, 2)


@functools.cache
def start() -> Discriminator:
    return jax.jit(lambda key: make(expert_data()).init(key))(jax.random.key(0))


@jax.jit
def advance(
    state: Discriminator, steps: Transition, expert: ExpertData, key: jax.Array
) -> tuple[jax.Array, Discriminator, Metrics]:
    """(rewards before the update, state after it, its metrics)."""
    model = make(expert)
    return model.reward(state, steps), *model.update(state, steps, key)


@functools.cache
def trained() -> tuple[Discriminator, Metrics]:
    """After 40 updates against a learner at -1, the expert being at 1."""
    state, metrics, expert, steps = start(), {}, expert_data(), transition(*samples(-1.0, seed=1))
    for key in jax.random.split(jax.random.key(1), 40):
        _, state, metrics = advance(state, steps, expert, key)
    return state, metrics


# The optimum ---------------------------------------------------------------------------------------------------------


def test_the_loss_typed_by_hand() -> None:
    zero, two = jnp.zeros(3), jnp.full(2, 2.0)
    # A logit of 0 costs log 2 on either side and has entropy log 2.
    np.testing.assert_allclose(reward_models.classification_loss(zero, zero[:1], 0.0), 2 * math.log(2), rtol=1e-6)
    np.testing.assert_allclose(reward_models.classification_loss(zero, zero, 0.5), 1.5 * math.log(2), rtol=1e-6)
    # Expert at h = 2: -log sigmoid(2) = log(1 + e^-2). Learner at h = 2: log(1 + e^2). It is right about the expert.
    right, wrong = math.log1p(math.exp(-2)), math.log1p(math.exp(2))
    np.testing.assert_allclose(reward_models.classification_loss(two, zero, 0.0), right + math.log(2), rtol=1e-6)
    np.testing.assert_allclose(reward_models.classification_loss(zero, two, 0.0), wrong + math.log(2), rtol=1e-6)


def test_a_table_of_logits_converges_to_the_density_ratio() -> None:
    """D* = p / (p + q) on five states, p the learner's and q the expert's frequencies, D = sigmoid(-h).

    The minimum is then 2 log 2 - 2 JS(p, q). (The entropy bonus would pull D* towards 1/2: its coefficient is 0.)
    """
    learner = np.repeat(np.arange(5), [20, 10, 6, 3, 1])  # 40 samples
    expert = np.repeat(np.arange(5), [1, 2, 5, 8, 4])  # 20: the numbers must not matter, only the frequencies
    p, q = np.bincount(learner) / 40, np.bincount(expert) / 20
    with jax.enable_x64(True):

        def loss(table: jax.Array) -> jax.Array:
            return reward_models.classification_loss(table[jnp.asarray(expert)], table[jnp.asarray(learner)], 0.0)

        descend = jax.jit(lambda: jax.lax.fori_loop(0, 2000, lambda _, h: h - 2.0 * jax.grad(loss)(h), jnp.zeros(5)))
        table = descend()
        value = float(jax.jit(loss)(table))
    np.testing.assert_allclose(1 / (1 + np.exp(np.asarray(table))), p / (p + q), rtol=1e-6)
    middle = (p + q) / 2
    divergence = (np.sum(p * np.log(p / middle)) + np.sum(q * np.log(q / middle))) / 2
    np.testing.assert_allclose(value, 2 * math.log(2) - 2 * divergence, rtol=1e-9)


def test_the_gradient_penalty_typed_by_hand() -> None:
    key, rng = jax.random.key(0), np.random.default_rng(0)
    one, two = (jnp.asarray(rng.normal(size=(6, 2)), jnp.float32) for _ in range(2))
    # The slope of a plane is the same everywhere: |(3, 4)| = 5.
    plane = reward_models.gradient_penalty(lambda x: x @ jnp.array([3.0, 4.0]), one, two, key)
    np.testing.assert_allclose(plane, (5 - 1) ** 2, rtol=1e-6)
    # Between a point and itself there is only that point; the slope of |x|^2 / 2 is x.
    bowl = reward_models.gradient_penalty(lambda x: jnp.sum(x**2, axis=-1) / 2, one, one, key)
    np.testing.assert_allclose(bowl, np.mean((np.linalg.norm(one, axis=1) - 1) ** 2), rtol=1e-5)
    # Between (0, 0) and (c, c) lies the diagonal, on which (x_0 - x_1)^2 is flat.
    diagonal = jnp.broadcast_to(one[:, :1], (6, 2))
    flat = reward_models.gradient_penalty(lambda x: (x[..., 0] - x[..., 1]) ** 2, 0 * one, diagonal, key)
    np.testing.assert_allclose(flat, 1, rtol=1e-5)


def test_the_gradient_penalty_of_a_flat_function_has_a_finite_gradient() -> None:
    ones = jnp.ones((3, 2))

    def penalty(scale: jax.Array) -> jax.Array:
        return reward_models.gradient_penalty(lambda x: scale * x.sum(axis=-1), ones, -ones, jax.random.key(0))

    assert np.isfinite(jax.grad(penalty)(jnp.zeros(())))


def test_the_gradient_penalty_draws_the_slope_to_one() -> None:
    expert, steps = expert_data(), transition(*samples(-1.0, seed=1))
    slopes = {}
    for regularizer in CHOICES["discriminator_regularizer"]:
        model = make(expert, discriminator_regularizer=regularizer, gradient_penalty_coefficient=100.0)
        state, key = start(), jax.random.key(1)
        update = jax.jit(model.update)
        for _ in range(40):
            state, _ = update(state, steps, key)
        reward = jax.jit(make(expert, reward_form="logit").reward)

        def total(obs: jax.Array, state: Discriminator = state, reward: Any = reward) -> jax.Array:
            return reward(state, steps.replace(obs=obs)).sum()

        slopes[regularizer] = np.linalg.norm(jax.grad(total)(steps.obs), axis=-1).mean()
    assert slopes["gradient_penalty"] < 1.2
    assert slopes["gradient_penalty"] < slopes["none"] / 1.5


# The reward ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", CHOICES["reward_form"])
def test_an_expert_like_learner_earns_more(form: str) -> None:
    reward = jax.jit(make(expert_data(), reward_form=form).reward)
    like_expert = reward(trained()[0], transition(*samples(1.0, seed=2)))
    like_learner = reward(trained()[0], transition(*samples(-1.0, seed=3)))
    assert like_expert.shape == (16, 4)
    assert like_expert.mean() > like_learner.mean() + 0.3
    signs = {"softplus": like_expert > 0, "logit": like_expert != 0, "log_sigmoid": like_expert < 0}
    assert np.all(signs[form])


def test_reward_forms_typed_by_hand() -> None:
    """With the paper's D = sigmoid(-h), 1 on the learner: -log D, -logit D, log(1 - D)."""
    h = np.array([-3.0, 0.0, 2.0])
    d = 1 / (1 + np.exp(h))
    np.testing.assert_allclose(reward_models.REWARD_FORMS["softplus"](jnp.asarray(h)), -np.log(d), rtol=1e-5)
    np.testing.assert_allclose(reward_models.REWARD_FORMS["logit"](jnp.asarray(h)), -np.log(d / (1 - d)), atol=1e-6)
    np.testing.assert_allclose(reward_models.REWARD_FORMS["log_sigmoid"](jnp.asarray(h)), np.log(1 - d), rtol=1e-5)
    # -log(D + 1e-8) would stop at 18.4.
    np.testing.assert_array_equal(reward_models.REWARD_FORMS["softplus"](jnp.array([50.0, 1e4])), [50.0, 1e4])


def test_the_discriminator_tells_both_sides_apart_and_says_so() -> None:
    metrics = trained()[1]
    assert metrics["discriminator_loss"] < 2 * math.log(2) - 0.3
    for side in ("expert", "learner", "held_out"):
        assert 0.7 < metrics[f"discriminator_accuracy_{side}"] <= 1


def test_the_tasks_reward_is_the_environments() -> None:
    model = reward_models.task()
    steps = transition(np.zeros((3, 2, 2)), np.zeros((3, 2, 2)))
    np.testing.assert_array_equal(model.reward(model.init(jax.random.key(0)), steps), np.full((3, 2), 3.0))
    assert model.update((), steps, jax.random.key(0)) == ((), {})


# What it is shown ----------------------------------------------------------------------------------------------------


def test_learner_actions_are_seen_as_they_were_sampled() -> None:
    """An action further beyond the range is judged anew, so that a policy out there is led back."""
    obs, action = samples(-1.0, seed=1)
    further = action.copy()
    action[0, 0], further[0, 0] = [1.5, -1.5], [9.0, -9.0]
    (one, _, _), (two, _, _) = (
        advance(trained()[0], transition(obs, a), expert_data(), jax.random.key(0)) for a in (action, further)
    )
    assert one[0, 0] != two[0, 0]
    assert same_bits(one[1:], two[1:])
    gradient = jax.grad(lambda a: make(expert_data()).reward(trained()[0], transition(obs, a)).sum())(further)
    assert np.all(np.linalg.norm(gradient, axis=-1) > 0)


def test_the_reward_is_that_of_the_moments_discriminator() -> None:
    """The same transitions are scored anew after an update, and alike without one."""
    steps, key = transition(*samples(-1.0, seed=1)), jax.random.key(1)
    first, after, _ = advance(start(), steps, expert_data(), key)
    again, second = advance(start(), steps, expert_data(), key)[0], advance(after, steps, expert_data(), key)[0]
    assert same_bits(first, again)
    assert not same_bits(first, second)


def test_its_statistics_hold_expert_and_learner_samples_in_equal_numbers() -> None:
    np.testing.assert_allclose(start().statistics.mean, np.asarray(expert_data().obs).mean(axis=0), rtol=1e-5)
    steps = transition(*samples(-5.0, seed=1))
    _, state, _ = advance(start(), steps, expert_data(), jax.random.key(0))
    assert state.statistics.count == 48 + 64 + 64
    # 48 + 64 samples near 1 and 64 near -5.
    np.testing.assert_allclose(state.statistics.mean, np.full(2, (112 * 1 - 64 * 5) / 176), atol=0.3)


def test_an_update_is_a_pass_in_minibatches() -> None:
    model = make(expert_data(), discriminator_steps=2, discriminator_minibatch_size=20)
    state, metrics = model.update(start(), transition(*samples(-1.0, seed=1)), jax.random.key(0))
    assert state.optimizer[0].count == 2 * 3  # 64 samples: three minibatches and 4 samples left over
    assert state.statistics.count == 48 + 2 * 3 * (20 + 20)
    assert np.isfinite(metrics["discriminator_loss"])


def test_held_out_samples_are_never_trained_on() -> None:
    steps, expert = transition(*samples(-1.0, seed=1)), expert_data()
    other = expert.replace(held_out_obs=expert.held_out_obs - 9, held_out_action=expert.held_out_action - 9)
    (_, one, metrics), (_, two, others) = (advance(start(), steps, e, jax.random.key(0)) for e in (expert, other))
    assert same_bits(one, two)
    assert metrics["discriminator_accuracy_held_out"] != others["discriminator_accuracy_held_out"]


def test_spectral_normalisation_divides_by_the_largest_singular_value() -> None:
    rng = np.random.default_rng(0)
    for shape in ((5, 100), (100, 100), (100, 1)):
        matrix = rng.normal(size=shape).astype(np.float32)
        found = reward_models.largest_singular_value(jnp.asarray(matrix), 200)
        np.testing.assert_allclose(found, np.linalg.norm(matrix, 2), rtol=1e-4)
        coarse = reward_models.largest_singular_value(jnp.asarray(matrix))
        np.testing.assert_allclose(coarse, np.linalg.norm(matrix, 2), rtol=0.05)
    # Its derivative is the outer product of the leading singular vectors.
    u, s, v = np.linalg.svd(matrix[:, :1] @ np.ones((1, 3), np.float32))
    slope = jax.grad(reward_models.largest_singular_value)(jnp.asarray(s[0] * np.outer(u[:, 0], v[0])))
    np.testing.assert_allclose(slope, np.outer(u[:, 0], v[0]), atol=1e-4)


def test_a_spectrally_normalised_network_is_lipschitz() -> None:
    config = Config(hidden_sizes=(16, 16))
    plain = networks.make_scalar(config, 4)
    network = reward_models.spectrally_normalized(plain)
    params = jax.tree.map(lambda leaf: 5 * leaf, network.init(jax.random.key(0)))
    inputs = jax.random.normal(jax.random.key(1), (200, 4))
    slopes = jnp.linalg.norm(jax.vmap(jax.grad(lambda x: network.apply(params, x)))(inputs), axis=-1)
    steep = jnp.linalg.norm(jax.vmap(jax.grad(lambda x: plain.apply(params, x)))(inputs), axis=-1)
    assert slopes.max() <= 1.05
    assert steep.max() > 2
