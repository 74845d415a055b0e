"""Launchers: options, run folders, statistics against values worked out by hand, and one tiny pipeline for real."""

import csv
import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ccil_jax.config import Config
from ccil_jax.demonstrations import load_demonstrations
from experiments import evaluate, expert, options, run_folder, train
from experiments.command_line import Parser, UsageError
from experiments.statistics import bootstrap_interval, interquartile_mean
from experiments.summary import Reference, aggregate_scores, per_seed_scores, scores

TINY = ["--preset", "tiny", "--max-episode-steps", "20", "--num-seeds", "2", "--eval-episodes", "3"]
REFERENCE = Reference(expert_return=110.0, expert_cost=40.0, random_return=10.0, random_cost=3.0, cost_limit=None)


@dataclasses.dataclass
class Episodes:
    """Stands in for `ccil_jax.evaluation.Evaluation`."""

    episode_return: np.ndarray
    episode_cost: np.ndarray
    episode_length: np.ndarray


@pytest.mark.parametrize(
    ("values", "expected"),
    [([7], 7), ([0, 10, 20], 10), ([100, 3, 2, 1, 0], 2), ([8, 1, 7, 2, 6, 3, 5, 4], 4.5), ([4, 1, 2, 3], 2.5)],
)
def test_interquartile_mean_drops_a_quarter_at_each_end(values: list[float], expected: float) -> None:
    assert interquartile_mean(np.array(values)) == expected


def test_bootstrap_interval_of_known_distributions() -> None:
    constant = bootstrap_interval([np.full(5, 3.0)])
    assert (constant.value, constant.low, constant.high) == (3.0, 3.0, 3.0)
    # Two values: a resample's mean is 0, 1/2 or 1 with probability 1/4, 1/2, 1/4.
    coin = [np.array([0.0, 1.0])]
    wide = bootstrap_interval(coin, np.mean)  # type: ignore[arg-type]
    assert (wide.value, wide.low, wide.high) == (0.5, 0.0, 1.0)
    narrow = bootstrap_interval(coin, np.mean, confidence=0.4)  # type: ignore[arg-type]
    assert (narrow.low, narrow.high) == (0.5, 0.5)


def test_bootstrap_interval_resamples_within_strata() -> None:
    stratified = bootstrap_interval([np.zeros(2), np.ones(2)])
    assert (stratified.low, stratified.high) == (0.5, 0.5)
    pooled = bootstrap_interval([np.array([0.0, 0.0, 1.0, 1.0])])
    assert pooled.low < 0.5 < pooled.high


def test_bootstrap_interval_covers_the_mean_of_a_normal_sample() -> None:
    sample = np.random.default_rng(1).normal(5.0, 2.0, 400)
    interval = bootstrap_interval([sample], np.mean)  # type: ignore[arg-type]
    half = 1.96 * sample.std() / 20
    np.testing.assert_allclose([interval.low, interval.high], [sample.mean() - half, sample.mean() + half], atol=0.03)
    assert bootstrap_interval([sample]) == bootstrap_interval([sample])


@pytest.mark.parametrize("strata", [[], [np.array([])], [np.array([1.0, np.nan])]])
def test_bootstrap_interval_refuses_what_has_none(strata: list[np.ndarray]) -> None:
    with pytest.raises(ValueError, match="value"):
        bootstrap_interval(strata)


def test_scores_are_those_of_the_specification() -> None:
    row = scores(60.0, 50.0, REFERENCE)
    assert row["recovered_return"] == 50.0  # (60 - 10) / (110 - 10)
    assert row["cost_violation"] == 10.0
    assert row["relative_cost_violation"] == 0.25
    assert row["penalized_return"] == 25.0
    assert scores(110.0, 30.0, REFERENCE)["penalized_return"] == 100.0  # no credit for staying below
    assert scores(110.0, 4000.0, REFERENCE)["penalized_return"] == -400.0  # relative violation capped at 5
    free = dataclasses.replace(REFERENCE, expert_cost=0.25)
    assert scores(0.0, 1.0, free)["relative_cost_violation"] == 0.75  # divided by at least 1


def test_scores_without_an_expert_use_the_prescribed_limit() -> None:
    reference = Reference(expert_return=None, expert_cost=None, random_return=0.0, random_cost=0.0, cost_limit=20.0)
    row = scores(60.0, 30.0, reference)
    assert row["cost_violation"] == 10.0
    assert row["recovered_return"] is None
    assert row["penalized_return"] is None


def test_seeds_are_aggregated_by_interquartile_mean() -> None:
    returns = np.array([[0.0, 20.0], [20.0, 20.0], [30.0, 30.0], [1000.0, 1000.0]])
    rows = per_seed_scores(Episodes(returns, 0 * returns, 0 * returns + 7), np.array([0.1, 0.2, 0.3, 0.4]), REFERENCE)
    assert [row["episode_return"] for row in rows] == [10.0, 20.0, 30.0, 1000.0]
    aggregate = aggregate_scores(rows)
    assert aggregate["episode_return"] is not None
    assert aggregate["episode_return"]["iqm"] == 25.0
    assert aggregate["episode_return"]["mean"] == 265.0
    assert aggregate["episode_length"] == {"iqm": 7.0, "low": 7.0, "high": 7.0, "mean": 7.0, "std": 0.0}
    rows[0]["recovered_return"] = None
    assert aggregate_scores(rows)["recovered_return"] is None


def test_options_are_the_fields_of_config() -> None:
    parser = Parser("x", "")
    options.add_config_options(parser)
    arguments = parser.parse_args(
        ["--max_kl", "0.02", "--num-envs=8", "--hidden-sizes", "32,16", "--env_steps", "3e5"]
        + ["--bootstrap_at_truncation", "false"]
    )
    given = vars(arguments)
    assert given == {
        "max_kl": 0.02,
        "num_envs": 8,
        "hidden_sizes": (32, 16),
        "env_steps": 300_000,
        "bootstrap_at_truncation": False,
    }
    assert options.config_from(given, "paper") == Config(**given)
    assert options.config_from({"batch_size": 400}, "tiny").hidden_sizes == (8, 8)
    assert set(options.CONFIG_FIELDS) <= set(vars(parser.parse_args(_every_option())))


def _every_option() -> list[str]:
    given: list[str] = []
    for field in dataclasses.fields(Config):
        value = field.default
        text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        given += ["--" + field.name, text]
    return given


def metrics(num_iterations: int, first: int = 0, **more: float) -> dict[str, np.ndarray]:
    """Two seeds; every number tells its iteration and seed."""
    steps = np.arange(first + 1, first + num_iterations + 1)[:, None] * np.ones((1, 2))
    values = {"env_steps": 100 * steps, "episode_return": steps + np.array([[0.0, 0.5]])}
    return {**values, **{name: np.full((num_iterations, 2), value) for name, value in more.items()}}


def test_metrics_file_has_one_row_per_iteration_and_seed(tmp_path: Path) -> None:
    with run_folder.MetricsWriter(tmp_path) as writer:
        writer.write(2, metrics(2, kl=0.01, new_metric=1.0))
        writer.write(3, metrics(1, first=2, kl=0.02, new_metric=1.0))
    with (tmp_path / "metrics.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["iteration", "seed", "env_steps", "episode_return", "kl", "new_metric"]
    assert rows[1:3] == [["1", "0", "100", "1", "0.01", "1"], ["1", "1", "100", "1.5", "0.01", "1"]]
    assert [row[:2] for row in rows[1:]] == [[str(i), str(s)] for i in (1, 2, 3) for s in (0, 1)]
    read = run_folder.read_metrics(tmp_path)
    np.testing.assert_array_equal(read["episode_return"], [[1, 1.5], [2, 2.5], [3, 3.5]])
    assert "iteration" not in read
    assert list(tmp_path.glob("events.*"))


def test_a_resumed_run_repeats_no_row(tmp_path: Path) -> None:
    with run_folder.MetricsWriter(tmp_path) as writer:
        writer.write(4, metrics(4))  # killed after iteration 4, the last checkpoint being that of iteration 2
    with run_folder.MetricsWriter(tmp_path) as writer:
        writer.write(3, metrics(1, first=2))
        writer.write(4, metrics(1, first=3))
    np.testing.assert_array_equal(run_folder.read_metrics(tmp_path)["env_steps"][:, 0], [100, 200, 300, 400])
    with run_folder.MetricsWriter(tmp_path) as writer, pytest.raises(UsageError, match="columns differ"):
        writer.write(3, metrics(1, first=2, kl=0.1))


@pytest.mark.parametrize("content", [None, "", "iteration,seed\n", "iteration,seed,x\n1,0,1\n1,1\n"])
def test_damaged_metrics_are_reported(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "metrics.csv").write_text(content)
    with pytest.raises(UsageError, match=r"metrics\.csv: missing, empty or damaged"):
        run_folder.read_metrics(tmp_path)


def test_json_is_strict_and_whole(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    run_folder.write_json(path, {"a": np.float32(0.5), "b": float("nan"), "c": (1, np.array([2.0, np.inf]))})
    assert json.loads(path.read_text()) == {"a": 0.5, "b": None, "c": [1, [2.0, None]]}
    with pytest.raises(TypeError):
        run_folder.write_json(path, {"a": object()})
    assert json.loads(path.read_text())["a"] == 0.5
    assert run_folder.git_commit() is None or len(run_folder.git_commit() or "") >= 40


def test_the_expert_is_the_best_seed_within_the_limit() -> None:
    rows = [
        {"seed": 0, "episode_return": 50.0, "episode_cost": 31.0},
        {"seed": 1, "episode_return": 20.0, "episode_cost": 10.0},
        {"seed": 2, "episode_return": 40.0, "episode_cost": 30.0},
    ]
    assert expert.choose_seed(rows, 30.0) == 2
    assert expert.choose_seed(rows, None) == 0
    assert expert.choose_seed(rows, 5.0) is None


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An expert, its demonstrations, and malm on them, all tiny: folders `expert` and `malm`, file `expert.npz`."""
    folder = tmp_path_factory.mktemp("pipeline")
    made = ["--env", "Swimmer", "--out", f"{folder}/expert.npz", "--run-dir", f"{folder}/expert", *TINY]
    assert expert.main([*made, "--num-trajectories", "4", "--cost-limit", "20"]) == 0
    assert train.main(malm(folder)) == 0
    return folder


def malm(folder: Path, *more: str) -> list[str]:
    demos = f"{folder}/expert.npz"
    return ["--method", "malm", "--env", "Swimmer", "--demos", demos, "--out", f"{folder}/malm", *TINY, *more]


def test_expert_writes_demonstrations_that_say_where_they_are_from(pipeline: Path) -> None:
    demonstrations = load_demonstrations(pipeline / "expert.npz")
    assert demonstrations.num_episodes == 4
    assert demonstrations.obs.shape == (80, 8)
    assert demonstrations.truncated.sum() == 4
    facts = demonstrations.metadata
    assert (facts["task"], facts["method"], facts["cost_limit"]) == ("Swimmer", "expert", 20.0)
    assert (facts["cost_threshold"], facts["max_episode_steps"]) == (1.0, 20)
    assert "jax" in facts["versions"]
    assert facts["evaluation"]["episode_cost"] <= 20.0


def test_train_writes_the_run_folder(pipeline: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = pipeline / "malm"
    names = {path.name.split(".out")[0] for path in folder.iterdir()}
    assert names == {"config.json", "metrics.csv", "summary.json", "checkpoints", "figures", "events"}
    run = run_folder.read_run(folder)
    assert run.config.method == "malm"
    assert run.facts["demonstrations"]["sha256"] == run_folder.sha256(pipeline / "expert.npz")
    rows = run_folder.read_metrics(folder)
    assert rows["env_steps"].tolist() == [[120.0, 120.0], [240.0, 240.0]]
    assert {"cost_rate", "multiplier", "meta_gradient", "discriminator_accuracy_held_out"} <= set(rows)
    assert all(np.isfinite(values).all() for values in rows.values())
    for name in ("curves", "episode_return", "episode_cost", "cost_rate"):
        assert (folder / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    summary = run_folder.read_json(folder / "summary.json")
    assert [row["seed"] for row in summary["per_seed"]] == [0, 1]
    assert summary["expert_cost"] == load_demonstrations(pipeline / "expert.npz").mean_episode_cost
    assert summary["env_steps"] == 240
    assert summary["env_steps_per_second"] > 0
    assert set(summary["aggregate"]) >= {"episode_return", "episode_cost", "recovered_return", "penalized_return"}


def test_evaluate_agrees_with_the_original_simulator(pipeline: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for simulator in ("ours", "original"):
        assert evaluate.main([f"{pipeline}/malm", "--episodes", "40", "--simulator", simulator]) == 0
    content = run_folder.read_json(pipeline / "malm" / "evaluation.json")
    assert set(content) == {"ours", "original"}
    for ours, theirs in zip(content["ours"]["per_seed"], content["original"]["per_seed"], strict=True):
        assert ours["episode_length"] == theirs["episode_length"] == 20.0
        assert abs(ours["episode_return"] - theirs["episode_return"]) < 3.0  # 40 episodes of an untrained policy
        assert abs(ours["episode_cost"] - theirs["episode_cost"]) < 3.0
    assert "seed 1" in capsys.readouterr().out


def test_numpy_policy_is_the_learnt_policy() -> None:
    import jax
    import jax.numpy as jnp

    from ccil_jax import networks, running_statistics
    from ccil_jax.rollout import Actor, act
    from experiments.original import NumpyPolicy

    random = np.random.default_rng(0)
    for activation in ("tanh", "relu", "swish"):
        config = Config(hidden_sizes=(16, 8), activation=activation)
        policy = networks.make_policy(config, 5, 3)
        statistics = running_statistics.update(running_statistics.init(5), jnp.asarray(random.normal(2, 3, (50, 5))))
        actor = Actor(policy_params=policy.init(jax.random.key(1)), obs_statistics=statistics)
        obs = random.normal(2, 10, (20, 5)).astype(np.float32)
        expected = act(policy.apply, actor, jnp.asarray(obs), jnp.zeros((20, 3)))
        mode = np.stack([NumpyPolicy(config, actor).mode(x) for x in obs])
        np.testing.assert_allclose(mode, expected, atol=1e-5)


def test_a_finished_run_can_be_resumed_and_stays_as_it_is(pipeline: Path) -> None:
    before = (pipeline / "malm" / "metrics.csv").read_text()
    assert train.main(["--resume", "--out", f"{pipeline}/malm"]) == 0
    assert (pipeline / "malm" / "metrics.csv").read_text() == before


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--max-kl", "0.5"], "--max-kl 0.5: the run in"),
        (["--num-seeds", "3"], "--num-seeds 3: the run in"),
        (["--method", "ccil"], "--method ccil: the run in"),
    ],
)
def test_resume_refuses_other_choices(
    pipeline: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        train.main([*malm(pipeline), "--resume", *more])
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_resume_refuses_other_demonstrations(
    pipeline: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from ccil_jax.demonstrations import save_demonstrations

    save_demonstrations(tmp_path / "other.npz", load_demonstrations(pipeline / "expert.npz").take_episodes(2))
    with pytest.raises(SystemExit):
        train.main(["--resume", "--out", f"{pipeline}/malm", "--demos", f"{tmp_path}/other.npz"])
    assert "other.npz: not the file that the run" in capsys.readouterr().err


def test_no_seed_within_the_limit_is_a_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [{"seed": 0, "episode_return": 1.0, "episode_cost": 21.0}]
    monkeypatch.setattr(expert, "execute", lambda plan: SimpleNamespace(summary={"per_seed": rows}))
    made = ["--env", "Swimmer", "--out", f"{tmp_path}/e.npz", "--run-dir", f"{tmp_path}/run", *TINY]
    assert expert.main([*made, "--cost-limit", "20"]) == 1
    assert "no seed keeps --cost-limit 20 (lowest cost 21)" in capsys.readouterr().err
    assert not (tmp_path / "e.npz").exists()
