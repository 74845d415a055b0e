"""Random orders: every index once, a new order for a new key, partial batches dropped."""

import jax
import numpy as np
import pytest

from ccil_jax.learning import minibatches


@pytest.mark.parametrize("num_samples", [50, 4096, 4097])  # by one sort of either kind
def test_a_permutation_holds_every_index_once(num_samples: int) -> None:
    one, two = (np.asarray(minibatches.permutation(jax.random.key(seed), num_samples)) for seed in (0, 1))
    np.testing.assert_array_equal(np.sort(one), np.arange(num_samples))
    for before, after in ((one, two), (np.arange(num_samples), one), (one[:-1], one[1:])):
        assert abs(np.corrcoef(before, after)[0, 1]) < 4 / np.sqrt(num_samples)  # four standard errors


def test_a_single_sample_has_one_order() -> None:
    np.testing.assert_array_equal(minibatches.permutation(jax.random.key(0), 1), [0])


def test_every_first_index_is_about_as_likely() -> None:
    keys = jax.random.split(jax.random.key(0), 4000)
    first = jax.vmap(lambda key: minibatches.permutation(key, 4)[0])(keys)
    np.testing.assert_allclose(np.bincount(np.asarray(first)) / 4000, 0.25, atol=0.03)  # four standard errors


def test_minibatches_of_a_pass_share_no_sample_and_drop_the_rest() -> None:
    batches = np.asarray(minibatches.minibatches(jax.random.key(0), 11, minibatch_size=3, num_epochs=1))
    assert batches.shape == (3, 3)
    assert len(np.unique(batches)) == 9
    assert set(batches.flat) <= set(range(11))


def test_every_pass_has_an_order_of_its_own() -> None:
    batches = np.asarray(minibatches.minibatches(jax.random.key(0), 12, minibatch_size=4, num_epochs=2))
    one, two = batches.reshape(2, 12)
    for order in (one, two):
        np.testing.assert_array_equal(np.sort(order), np.arange(12))
    assert (one != two).any()
