"""The mutation check itself: its snippets are still in the sources, and three mutations are killed here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ccil_jax.learning import constraints, reward_models
from ccil_jax.learning.constraints import Outer
from tests.mutations import MUTATIONS, ROOT, Mutation


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.name)
def test_a_mutation_can_be_made(mutation: Mutation) -> None:
    assert (ROOT / mutation.file).read_text(encoding="utf-8").count(mutation.before) == 1
    assert all((ROOT / name).is_file() for name in mutation.tests)


def test_flipped_labels_would_be_noticed() -> None:
    """The loss falls where the expert's logits rise; with the labels flipped it would rise."""
    logits = jnp.zeros(3)
    on_expert, on_learner = jax.grad(reward_models.classification_loss, argnums=(0, 1))(logits, logits, 0.0)
    assert (np.asarray(on_expert) < 0).all()
    assert (np.asarray(on_learner) > 0).all()


def test_a_dropped_indirect_term_would_be_noticed() -> None:
    """Weights that grow with lambda: d/d lambda mean((w A - lambda' d)^2) = 2 (w A - lambda' d) A w'."""
    outer = Outer(
        reward_advantage=jnp.array([2.0]),
        cost_advantage=jnp.array([0.0]),
        cost=jnp.array([1.0]),
        importance_weights=lambda x: 1 + 3 * x[None],
    )
    found = {
        kind: float(constraints.outer_gradient(kind, jnp.asarray(0.1), jnp.asarray(0.2), outer))
        for kind in ("full", "indirect", "direct")
    }
    residual = 1.3 * 2.0 - 0.2
    np.testing.assert_allclose(found["indirect"], 2 * residual * 2.0 * 3, rtol=1e-5)
    np.testing.assert_allclose(found["full"], found["indirect"] - 2 * residual, rtol=1e-5)
    np.testing.assert_allclose(found["direct"], -2 * (2.0 - 0.2), rtol=1e-5)
