"""Several configurations in one program: each run has its own numbers, and shares nothing with the others."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from ccil_jax import runner
from ccil_jax.config import Config, ConfigError
from ccil_jax.runner import Result
from tests.probe_envs import Walk, quick_compilation, same_bits, walk_config, walk_demonstrations

NUM_SEEDS = 2
CHOICES = ((1.0, 0.02, 0.5), (2.0, 0.0, 0.25), (0.5, 0.1, 0.0))  # cost limit, step size and start of the multiplier


def config(limit: float, rate: float, start: float, **changes: Any) -> Config:
    return walk_config(
        method="lgail",
        multiplier_update="sgd",
        cost_limit=limit,
        multiplier_learning_rate=rate,
        initial_multiplier=start,
        **changes,
    )


def train(*choices: tuple[float, float, float], **settings: Any) -> list[Result]:
    configs = [config(*choice) for choice in choices]
    with quick_compilation():
        return runner.train_runs(configs, Walk(), walk_demonstrations(), num_seeds=NUM_SEEDS, seed=3, **settings)


@pytest.fixture(scope="module")
def results() -> list[Result]:
    return train(*CHOICES)


def test_every_run_has_its_own_numbers(results: list[Result]) -> None:
    """The multiplier recomputed from the logged costs: lambda + rate (J - limit), not below 0."""
    for result, (limit, rate, start) in zip(results, CHOICES, strict=True):
        assert result.config == config(limit, rate, start)
        assert result.metrics["multiplier"].shape == (20, NUM_SEEDS)
        expected = np.full(NUM_SEEDS, start)
        for cost, multiplier in zip(result.metrics["episode_cost"], result.metrics["multiplier"], strict=True):
            expected = np.clip(expected + rate * (cost - limit), 0.0, 100.0)
            np.testing.assert_allclose(multiplier, expected, atol=1e-5)
    assert len({float(r.metrics["multiplier"][-1, 0]) for r in results}) == len(CHOICES)


def test_the_order_of_the_configurations_does_not_matter(results: list[Result]) -> None:
    for result, same in zip(results, reversed(train(*reversed(CHOICES))), strict=True):
        assert same_bits((result.state, result.metrics), (same.state, same.metrics))


def test_a_run_begins_as_it_would_alone(results: list[Result]) -> None:
    """The same seeds; later, programs of other widths round differently."""
    alone = train(CHOICES[0])[0]
    for name, rows in alone.metrics.items():
        np.testing.assert_allclose(results[0].metrics[name][0], rows[0], rtol=1e-4, atol=1e-5, err_msg=name)


def test_stopped_and_resumed_together(results: list[Result], tmp_path: Path) -> None:
    train(*CHOICES, checkpoint_dir=tmp_path / "together", stop_after=10)
    resumed = train(*CHOICES, checkpoint_dir=tmp_path / "together", resume=True)
    for i, (result, same) in enumerate(zip(results, resumed, strict=True)):
        assert same_bits((result.state, result.metrics), (same.state, same.metrics))
        runner.save(result, tmp_path / str(i))
        loaded = runner.load(result.config, Walk(), tmp_path / str(i), NUM_SEEDS)
        assert same_bits(loaded.agent, result.agent)


def test_only_traced_fields_may_differ() -> None:
    with pytest.raises(ConfigError, match="hidden_sizes"):
        runner.train_runs([walk_config(method="trpo"), walk_config(method="trpo", hidden_sizes=(5,))], Walk())


def test_fields_that_agree_stay_numbers() -> None:
    shared, varied = runner.join([config(1.0, 0.1, 0.0), config(1.0, 0.2, 0.0)], num_seeds=2)
    assert shared.cost_limit == 1.0
    assert list(varied) == ["multiplier_learning_rate"]
    np.testing.assert_array_equal(varied["multiplier_learning_rate"], np.float32([0.1, 0.1, 0.2, 0.2]))
    assert runner.join([config(1.0, 0.1, 0.0)] * 2, num_seeds=2)[1] == {}
    assert isinstance(varied["multiplier_learning_rate"], jax.Array)
