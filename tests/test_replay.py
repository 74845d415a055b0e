"""The ring of a learner's latest steps."""

import jax
import jax.numpy as jnp
import numpy as np

from ccil_jax.agents import replay
from ccil_jax.agents.replay import Replay
from ccil_jax.types import Transition


def steps(first: int) -> Transition:
    """Two simulations' steps number `first` and `first + 1`; every entry tells which it is."""
    number = jnp.array([[first, first + 1]], jnp.float32)
    no = jnp.zeros((1, 2), bool)
    return Transition(
        obs=number[..., None],
        action=-number[..., None],
        next_obs=number[..., None] + 0.5,
        reward=number,
        cost=number,
        terminated=number % 3 == 0,
        done=no,
        whole=no,
        episode_return=number,
        episode_cost=number,
        episode_length=jnp.ones((1, 2), jnp.int32),
    )


def filled(num_steps: int) -> Replay:
    ring = replay.init(6, 1, 1)
    for first in range(0, num_steps, 2):
        ring = replay.add(ring, steps(first))
    return ring


def test_the_latest_rows_replace_the_oldest() -> None:
    ring = filled(10)
    assert ring.num_added == 10
    order = np.argsort(ring.obs[:, 0])
    expected = np.arange(4.0, 10.0)
    np.testing.assert_array_equal(np.asarray(ring.obs)[order, 0], expected)
    np.testing.assert_array_equal(np.asarray(ring.action)[order, 0], -expected)
    np.testing.assert_array_equal(np.asarray(ring.next_obs)[order, 0], expected + 0.5)
    np.testing.assert_array_equal(np.asarray(ring.terminated)[order], expected % 3 == 0)


def test_only_filled_rows_are_chosen_and_all_of_them() -> None:
    for num_steps, rows in ((4, {0, 1, 2, 3}), (10, {0, 1, 2, 3, 4, 5})):
        assert set(np.asarray(replay.choose(filled(num_steps), 200, jax.random.key(0))).tolist()) == rows
