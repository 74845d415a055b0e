"""Random orders: every index once, a new order for a new key, partial batches dropped."""

import jax
import numpy as np

from ccil_jax import shuffling


def test_a_permutation_holds_every_index_once() -> None:
    one, two = (np.asarray(shuffling.permutation(jax.random.key(seed), 50)) for seed in (0, 1))
    np.testing.assert_array_equal(np.sort(one), np.arange(50))
    assert (one != two).any()
    assert (one != np.arange(50)).any()


def test_every_first_index_is_about_as_likely() -> None:
    keys = jax.random.split(jax.random.key(0), 4000)
    first = jax.vmap(lambda key: shuffling.permutation(key, 4)[0])(keys)
    np.testing.assert_allclose(np.bincount(np.asarray(first)) / 4000, 0.25, atol=0.03)  # four standard errors


def test_minibatches_of_a_pass_share_no_sample_and_drop_the_rest() -> None:
    batches = np.asarray(shuffling.minibatches(jax.random.key(0), 11, minibatch_size=3, num_epochs=1))
    assert batches.shape == (3, 3)
    assert len(np.unique(batches)) == 9
    assert set(batches.flat) <= set(range(11))


def test_every_pass_has_an_order_of_its_own() -> None:
    batches = np.asarray(shuffling.minibatches(jax.random.key(0), 12, minibatch_size=4, num_epochs=2))
    one, two = batches.reshape(2, 12)
    for order in (one, two):
        np.testing.assert_array_equal(np.sort(order), np.arange(12))
    assert (one != two).any()
