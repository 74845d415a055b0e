"""Methods that are one another's special cases (specs/algorithms.md section 2), bit for bit on a whole training run.

Every run is the production path: `build.resolve`, then `init` and iterations of `on_policy.make`, jitted and vmapped
over seeds.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest

from ccil_jax import methods
from ccil_jax.acting import running_statistics
from ccil_jax.agents import build, on_policy
from ccil_jax.agents.expert import expert_data
from ccil_jax.agents.on_policy import AgentState
from ccil_jax.config import Config
from ccil_jax.learning import reward_models
from ccil_jax.types import ExpertData, Metrics
from tests.probe_envs import (
    WALK_DEMONSTRATIONS_COST,
    Walk,
    quick_compilation,
    same_bits,
    walk_config,
    walk_demonstrations,
)

pytestmark = pytest.mark.once

Run = tuple[AgentState, Metrics]
NUM_ITERATIONS = 4  # of two generator steps: the second iteration's rewards, multipliers and statistics have moved


@functools.cache
def program(reward: str) -> Callable[[Config, ExpertData | None, jax.Array], Run]:
    """One jitted function for all configurations. `reward` keeps a run with another reward model apart in its cache."""

    @jax.jit
    def run(config: Config, expert: ExpertData | None, keys: jax.Array) -> Run:
        agent = on_policy.make(config, Walk(), expert)

        def train(key: jax.Array) -> Run:
            return jax.lax.scan(lambda state, _: agent.step(state), agent.init(key), None, length=NUM_ITERATIONS)

        return jax.vmap(train)(keys)

    return run


def train(config: Config, reward: str = "the row's") -> Run:
    demonstrations = walk_demonstrations()
    config = build.resolve(config, Walk(), demonstrations)
    with quick_compilation():
        return program(reward)(config, expert_data(demonstrations), jax.random.split(jax.random.key(0), 2))


@functools.cache
def ccil() -> Run:
    return train(walk_config(method="ccil"))


def frozen(**changes: Any) -> Config:
    """A multiplier that starts at 0 and stays there."""
    changes = {"multiplier_update": "sgd", "initial_multiplier": 0.0, "multiplier_learning_rate": 0.0} | changes
    return walk_config(method="ccil", **changes)


@functools.cache
def gail() -> Run:
    return train(walk_config(method="gail"))


def assert_equal(one: Run, other: Run, but: tuple[str, ...] = ()) -> None:
    """Equal bits in every field of the state and every metric, `but` for the named."""
    for name in {field for field in vars(one[0]) if field not in but}:
        assert same_bits(getattr(one[0], name), getattr(other[0], name)), name
    assert set(one[1]) - set(but) == set(other[1]) - set(but)
    for name in set(one[1]) - set(but):
        assert same_bits(one[1][name], other[1][name]), name


def test_the_runs_are_worth_comparing() -> None:
    """Policies move, multipliers and rewards change, episodes end, and nothing is NaN."""
    metrics = {name: np.asarray(value) for name, value in ccil()[1].items()}
    assert all(np.isfinite(value).all() for value in metrics.values())
    assert (metrics["step_fraction"] > 0).all()
    assert (metrics["episodes_finished"] > 0).all()
    assert np.ptp(metrics["multiplier"], axis=1).min() > 0
    assert np.ptp(metrics["imitation_reward"], axis=1).min() > 0
    assert np.abs(metrics["episode_cost"] - WALK_DEMONSTRATIONS_COST).min() > 0


def test_lgail_with_the_experts_cost_as_its_limit_is_ccil() -> None:
    lgail = train(walk_config(method="lgail", cost_limit=WALK_DEMONSTRATIONS_COST))
    assert_equal(lgail, ccil())


def test_lgail_with_another_limit_is_not() -> None:
    lgail = train(walk_config(method="lgail", cost_limit=WALK_DEMONSTRATIONS_COST + 1))  # the same program
    assert not same_bits(lgail[0].actor, ccil()[0].actor)


def test_malm_with_the_meta_step_off_and_no_held_out_split_is_ccil() -> None:
    assert_equal(train(walk_config(method="malm", meta_gradient="none", held_out_fraction=0.0)), ccil())


def test_ccil_with_the_multiplier_frozen_at_0_is_gail() -> None:
    one = train(frozen())
    assert np.all(np.asarray(one[1]["multiplier"]) == 0)
    assert_equal(one, gail(), but=("constraint", "multiplier"))  # which gail does not have


def test_ccil_with_a_multiplier_that_moves_is_not_gail() -> None:
    one = train(frozen(initial_multiplier=0.5, multiplier_learning_rate=0.1))  # the same program
    assert not same_bits(one[0].actor, gail()[0].actor)


def test_gail_with_the_tasks_reward_in_the_discriminators_place_is_trpo(monkeypatch: pytest.MonkeyPatch) -> None:
    assert methods.METHODS["gail"].reward == "discriminator"
    trpo = train(walk_config(method="trpo"))
    assert not same_bits(gail()[0].actor, trpo[0].actor)
    monkeypatch.setattr(reward_models, "discriminator", lambda *_: reward_models.task())
    assert_equal(train(walk_config(method="gail"), reward="task"), trpo)


@pytest.mark.parametrize(("name", "choice"), [("pid_il", "pid"), ("cpo_il", "optimal")])
def test_a_row_with_its_own_multiplier_is_ccil_with_that_choice(name: str, choice: str) -> None:
    row = train(walk_config(method=name))
    assert_equal(row, train(walk_config(method="ccil", multiplier_update=choice)))
    assert not same_bits(row[0].actor, ccil()[0].actor)
    assert np.asarray(row[1]["cost_weight"]).max() > 0


def test_cpo_il_far_within_its_limit_is_gail(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "resolve", lambda config, *_: config)
    far, gail_run = (train(walk_config(method=name).replace(cost_limit=1e6), "far") for name in ("cpo_il", "gail"))
    # The estimate of an episode's cost begins at the limit, so before the first end of one there is no gap.
    assert_equal(far, gail_run)


def test_re_evaluated_advantages_are_the_stale_ones_where_nothing_was_learnt(monkeypatch: pytest.MonkeyPatch) -> None:
    """With frozen networks and statistics both are the same; with learning they differ, but only in the multiplier."""

    def malm(reward: str, **changes: Any) -> Run:
        return train(walk_config(method="malm", **changes), reward)

    stale, fresh = malm("the row's"), malm("the row's", outer_advantage="re-evaluated")
    gradients = [np.asarray(run[1]["meta_gradient"]) for run in (stale, fresh)]
    assert (gradients[0][:, 0] != gradients[1][:, 0]).all()
    for name in ("kl", "surrogate", "imitation_reward"):  # of the first iteration, before the multiplier is used
        assert same_bits(stale[1][name][:, 0], fresh[1][name][:, 0])
    monkeypatch.setattr(running_statistics, "normalize", lambda statistics, samples: samples)
    frozen_networks = {"critic_learning_rate": 0.0, "discriminator_learning_rate": 0.0}
    stale, fresh = (malm("frozen", **frozen_networks, outer_advantage=kind) for kind in ("stale", "re-evaluated"))
    np.testing.assert_allclose(stale[1]["meta_gradient"], fresh[1]["meta_gradient"], rtol=1e-4, atol=1e-6)
