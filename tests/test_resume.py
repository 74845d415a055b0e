"""A run that stops half-way and goes on from its checkpoint ends as the unbroken run does, bit for bit."""

from pathlib import Path

import jax
import numpy as np

from ccil_jax import runner
from ccil_jax.runner import Result
from tests.probe_envs import Walk, quick_compilation, same_bits, walk_config, walk_demonstrations


def train(
    directory: Path | None = None, *, resume: bool = False, stop_after: int | None = None, num_iterations: int = 20
) -> Result:
    with quick_compilation():
        return runner.train(
            walk_config(method="malm", env_steps=num_iterations * 64),
            Walk(),
            walk_demonstrations(),
            num_seeds=2,
            seed=3,
            checkpoint_dir=directory,
            resume=resume,
            stop_after=stop_after,
        )


def test_a_stopped_and_resumed_run_is_the_unbroken_run(tmp_path: Path) -> None:
    whole = train()
    half = train(tmp_path, stop_after=10)
    assert half.env_steps == whole.env_steps // 2 == 10 * 64
    assert not same_bits(half.state, whole.state)
    # Every call builds its program anew, as a new process would.
    resumed = train(tmp_path, resume=True)
    assert resumed.env_steps == whole.env_steps == 20 * 64
    assert same_bits(resumed.state, whole.state)
    assert set(resumed.metrics) == set(whole.metrics)
    for name, rows in whole.metrics.items():
        assert rows.shape == (20, 2)
        assert same_bits(resumed.metrics[name], rows), name
        assert same_bits(resumed.metrics[name][:10], half.metrics[name]), name
    np.testing.assert_array_equal(whole.metrics["env_steps"][:, 0], 64 * np.arange(1, 21))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(whole.metrics))


def test_a_longer_run_ends_where_it_should(tmp_path: Path) -> None:
    """Seven iterations in one chunk, then on to ten: no chunk may lead beyond."""
    short = train(tmp_path, num_iterations=7)
    longer = train(tmp_path, num_iterations=10, resume=True)
    assert longer.env_steps == 10 * 64
    np.testing.assert_array_equal(longer.metrics["env_steps"][:, 0], 64 * np.arange(1, 11))
    for name, rows in short.metrics.items():
        assert same_bits(longer.metrics[name][:7], rows), name
