"""Launchers: options, the choice of the expert, and one tiny pipeline for real."""

import dataclasses
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ccil_jax
from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import load_demonstrations
from ccil_jax.methods import METHODS
from ccil_jax.presets import PRESETS
from ccil_jax.training.filesystem import file_sha256
from experiments import evaluate, expert, train
from experiments.cli import options
from experiments.cli.command_line import Parser, UsageError, command
from experiments.runs import recording, run_folder
from experiments.runs.metrics_file import read_metrics
from tests.probe_envs import quick_compilation

TINY = ["--preset", "tiny", "--max-episode-steps", "20", "--num-seeds", "2", "--eval-episodes", "3"]


def test_options_are_the_fields_of_config() -> None:
    parser = Parser("x", "")
    options.add_config_options(parser, "paper")
    arguments = parser.parse_args(
        ["--max_kl", "0.02", "--num-envs=8", "--hidden-sizes", "32,16", "--env_steps", "3e5", "--gae_lambda=1"]
    )
    given = vars(arguments)
    assert given == {
        "max_kl": 0.02,
        "num_envs": 8,
        "hidden_sizes": (32, 16),
        "env_steps": 300_000,
        "gae_lambda": 1.0,
    }
    assert options.config_from(given, "paper") == Config(**given)
    assert options.config_from({"batch_size": 400}, "tiny").hidden_sizes == (8, 8)
    assert {*options.CONFIG_FIELDS} - {"method"} <= set(vars(parser.parse_args(_every_option())))


@pytest.mark.parametrize(("launcher", "name"), [(train, "default"), (expert, "expert")])
def test_help_shows_the_values_that_the_launcher_starts_from(launcher: ModuleType, name: str) -> None:
    text = " ".join(launcher.make_parser().format_help().split())
    preset = re.search(r"hyperparameters to start from \(default: (\w+)\)", text)
    assert preset
    assert preset[1] == name
    assert len({PRESETS[preset]["batch_size"] for preset in ("default", "expert")} | {Config().batch_size}) == 3
    assert f"rounded up to whole iterations (default: {PRESETS[name]['env_steps']}; static)" in text
    assert f"batch of its own (Table 1) (default: {PRESETS[name]['batch_size']}; static)" in text


def _every_option() -> list[str]:
    given: list[str] = []
    for field in dataclasses.fields(Config):
        if field.name == "method":  # the launchers' own
            continue
        value = field.default
        text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        given += ["--" + field.name, text]
    return given


@pytest.mark.parametrize(
    ("given", "preset"),
    [
        (["--env", "Swimmer"], "expert"),
        (["--env", "PointGoal1"], "safety_gym_expert"),
        (["--env", "PointGoal1", "--preset", "expert"], "expert"),
    ],
)
def test_an_expert_starts_from_the_preset_of_its_family(given: list[str], preset: str, tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "expert.npz"), "--run-dir", str(tmp_path / "run")]
    plan = expert.make_plan(expert.make_parser().parse_args([*given, *out]))
    assert plan.preset == preset
    assert plan.config.batch_size == PRESETS[preset]["batch_size"]


def test_the_expert_is_the_best_seed_within_the_limit() -> None:
    rows = [
        {"seed": 0, "episode_return": 50.0, "episode_cost": 31.0},
        {"seed": 1, "episode_return": 20.0, "episode_cost": 10.0},
        {"seed": 2, "episode_return": 40.0, "episode_cost": 30.0},
    ]
    assert expert.choose_seed(rows, 30.0) == 2
    assert expert.choose_seed(rows, None) == 0
    assert expert.choose_seed(rows, 5.0) is None


@pytest.fixture(scope="module", autouse=True)
def plain_code() -> Iterator[None]:
    """What is trained here is compiled quickly."""
    with quick_compilation():
        yield


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An expert, its demonstrations, and malm on them, all tiny: folders `expert` and `malm`, file `expert.npz`."""
    folder = tmp_path_factory.mktemp("pipeline")
    made = ["--env", "Swimmer", "--out", f"{folder}/expert.npz", "--run-dir", f"{folder}/expert", *TINY]
    made += ["--export", f"{folder}/policy.npz"]
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
    assert run.facts["demonstrations"]["sha256"] == file_sha256(pipeline / "expert.npz")
    rows = read_metrics(folder)
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


def test_evaluate_records_what_expert_recorded(
    pipeline: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same seed's policy in the same episodes."""
    original = load_demonstrations(pipeline / "expert.npz")
    again = [f"{pipeline}/expert", "--record", f"{tmp_path}/same.npz", "--num-trajectories", "4", "--episodes", "3"]
    again += ["--seed", str(original.metadata["episode_seed"] - 1), "--out", f"{tmp_path}/evaluation.json"]
    assert evaluate.main(again) == 0
    same = load_demonstrations(tmp_path / "same.npz")
    for field in dataclasses.fields(same):
        if field.name != "metadata":
            np.testing.assert_array_equal(getattr(same, field.name), getattr(original, field.name))
    assert same.metadata["command"].splitlines() == [original.metadata["command"], command()]
    for facts in (same.metadata, original.metadata):
        del facts["command"]
    assert same.metadata == original.metadata
    assert original.metadata["limit_kept"] is True
    assert original.metadata["versions"]["ccil_jax"] == ccil_jax.__version__
    assert original.metadata["trained_with"]["versions"] == original.metadata["versions"]
    assert "recorded demonstrations" in capsys.readouterr().out
    entry = run_folder.read_json(tmp_path / "evaluation.json")["ours"]
    assert entry["run"] == str(pipeline / "expert")
    assert entry["versions"]["ccil_jax"] == ccil_jax.__version__


def test_a_run_can_be_done_again_from_its_config_file(pipeline: Path, tmp_path: Path) -> None:
    """The same setup and hyperparameters as from the command line, and an option of one's own comes first."""
    parser, out = train.make_parser(), ["--out", f"{tmp_path}/new"]
    first = train.make_plan(parser.parse_args([*malm(pipeline), "--physics", "native", *out]))
    again = train.make_plan(parser.parse_args(["--config", f"{pipeline}/malm/config.json", *out]))
    assert (again.setup, again.config, again.preset) == (first.setup, first.config, first.preset)
    seeds = train.make_plan(parser.parse_args(["--config", f"{pipeline}/malm/config.json", *out, "--num-seeds", "7"]))
    assert seeds.setup.num_seeds == 7

    options: dict[str, Any] = {
        "method": "malm",
        "env": "Swimmer",
        "demos": f"{pipeline}/expert.npz",
        "hidden_sizes": [5, 6],
    }
    options |= {"max_episode_steps": 20}
    toml = "".join(f"{name} = {json.dumps(value)}\n" for name, value in options.items())
    for name, text in (("run.toml", toml), ("run.json", json.dumps(options))):
        (tmp_path / name).write_text(text)
        given = ["--config", f"{tmp_path}/{name}", "--preset", "tiny", "--env-steps", "80", *out]
        plan = train.make_plan(parser.parse_args(given))
        assert (plan.config.hidden_sizes, plan.config.env_steps, plan.preset) == ((5, 6), 80, "tiny")
        assert plan.setup.demonstrations_path == pipeline / "expert.npz"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('metod = "malm"', "--metod: unknown; did you mean --method?"),
        ('method = "malm"\nseed = -1', "--seed: -1"),
        ('method = "malm"\n[fixed]\nseed = 1', "fixed: a table; give the options of `train` side by side"),
        ("method = malm", "not TOML"),
        ('out = "elsewhere"', "--out: unknown"),
    ],
)
def test_a_wrong_config_file_is_named(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "run.toml"
    path.write_text(content)
    with pytest.raises(UsageError) as refused:
        train.make_plan(train.make_parser().parse_args(["--config", str(path), "--env", "Swimmer"]))
    assert str(refused.value).startswith(f"--config {path}: " if "TOML" not in message else f"--config {path}")
    assert message in str(refused.value)


def test_a_config_file_whose_demonstrations_are_gone_says_so(pipeline: Path, tmp_path: Path) -> None:
    content = run_folder.read_json(pipeline / "malm" / "config.json")
    content["demonstrations"]["file"] = f"{tmp_path}/gone.npz"
    run_folder.write_json(tmp_path / "config.json", content)
    with pytest.raises(UsageError, match=r"gone\.npz is no longer the file that this run learnt from; give it by"):
        train.make_plan(train.make_parser().parse_args(["--config", f"{tmp_path}/config.json"]))


def test_the_expert_can_be_had_from_its_file(
    pipeline: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Evaluated, recorded and exported again, without its run folder: the same policy, but for float32's rounding."""
    demonstrations = load_demonstrations(pipeline / "expert.npz")
    settings = ["--episodes", "3", "--seed", str(demonstrations.metadata["episode_seed"] - 1)]
    written = ["--record", f"{tmp_path}/same.npz", "--num-trajectories", "4", "--export", f"{tmp_path}/again.npz"]
    given = ["--policy", f"{pipeline}/policy.npz", *settings, "--out", f"{tmp_path}/evaluation.json"]
    assert evaluate.main([*given, *written]) == 0
    assert "expert on Swimmer" in capsys.readouterr().out
    entry = run_folder.read_json(tmp_path / "evaluation.json")["ours"]
    row = demonstrations.metadata["evaluation"]
    assert entry["per_seed"][0]["episode_return"] == pytest.approx(row["episode_return"], abs=1e-3)
    assert entry["cost_limit"] == 20.0
    same = load_demonstrations(tmp_path / "same.npz")
    np.testing.assert_allclose(same.obs, demonstrations.obs, atol=1e-3)
    for name in ("task", "method", "seed_index", "cost_limit", "env_options", "env_steps", "trained_with"):
        assert same.metadata[name] == demonstrations.metadata[name], name
    first, again = np.load(pipeline / "policy.npz"), np.load(tmp_path / "again.npz")
    for name in first:
        if name != "metadata":
            np.testing.assert_allclose(again[name], first[name], rtol=1e-5, atol=1e-3, err_msg=name)
    assert evaluate.main(["--policy", f"{tmp_path}/again.npz", "--episodes", "2", "--simulator", "original"]) == 0


def test_any_seed_can_be_recorded(pipeline: Path, tmp_path: Path) -> None:
    stored = run_folder.read_run(pipeline / "malm")
    summary = run_folder.read_json(pipeline / "malm" / "summary.json")
    arguments = evaluate.make_parser().parse_args([f"{pipeline}/malm", "--record", "new.npz", "--seed-index", "1"])
    trained = {**recording.training(stored, 240), "seed_indices": [0, 1]}
    source: Any = SimpleNamespace(run=stored)
    loaded: Any = SimpleNamespace(training=trained, command=stored.facts["command"])
    facts = evaluate.describe_recording(arguments, source, loaded, {})
    assert facts["seed_index"] == 1
    assert facts["evaluation"].pop("num_episodes") == summary["evaluation"]["num_episodes"]
    assert facts["evaluation"] == {name: summary["per_seed"][1][name] for name in facts["evaluation"]}
    assert facts["evaluation"].keys() > {"episode_return_standard_error", "episode_cost_standard_error"}
    assert facts["cost_limit"] == summary["expert_cost"]
    assert facts["limit_kept"] == (facts["evaluation"]["episode_cost"] <= summary["expert_cost"])
    assert facts["command"] == f"{stored.facts['command']}\n{command()}"


def test_files_are_replaced_only_if_asked_for(tmp_path: Path) -> None:
    old, out = tmp_path / "old.npz", tmp_path / "evaluation.json"
    old.write_bytes(b"old")
    given = [str(tmp_path), "--record", str(old), "--export", f"{tmp_path}/a.stablehlo"]
    with pytest.raises(UsageError, match=r"--record .*old\.npz: exists; choose another name or add --overwrite"):
        evaluate.check_files(evaluate.make_parser().parse_args(given), out)
    files = evaluate.check_files(evaluate.make_parser().parse_args([*given, "--overwrite"]), out)
    assert files == [("--out", out), ("--export", tmp_path / "a.stablehlo"), ("--record", old)]


@pytest.mark.parametrize(
    ("method", "limit"),
    [("malm", 12.0), ("lgail", 20.0), ("expert", 20.0), ("gail", None), ("bc", None), ("trpo", None)],
)
def test_the_limit_is_that_of_the_method(method: str, limit: float | None) -> None:
    config = Config(method=method, cost_limit=20.0 if METHODS[method].limit == "prescribed" else None)
    run: Any = SimpleNamespace(config=config, facts={"expert_cost": 12.0})
    assert recording.cost_limit(run) == limit


def test_exported_policies_are_the_learnt_ones(
    pipeline: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """1,000 observations: the program to the last bit, the NumPy arrays to 1e-5, actions as they are executed."""
    import jax
    import jax.numpy as jnp

    import envs
    from ccil_jax.acting import networks
    from ccil_jax.acting.rollout import act
    from ccil_jax.training import runner
    from experiments.policies.numpy_policy import policies

    files = [str(tmp_path / name) for name in ("policy.npz", "policy.stablehlo")]
    assert evaluate.main([f"{pipeline}/malm", "--episodes", "2", "--export", *files]) == 0
    said = capsys.readouterr().out
    assert all(f"policies {file}" in said for file in files)
    stored = run_folder.read_run(pipeline / "malm")
    env = envs.make("Swimmer", **stored.facts["env_options"])
    loaded = runner.load(stored.config, env, stored.folder / "checkpoints", num_seeds=2)
    random = np.random.default_rng(0)
    obs = random.normal(0, 3, (1000, env.obs_dim)).astype(np.float32)
    noise = random.standard_normal((1000, env.action_dim)).astype(np.float32)

    program = jax.export.deserialize(bytearray(Path(files[1]).read_bytes()))
    policy = networks.policy_of(stored.config, env)

    @jax.jit
    def learnt(obs: jax.Array, noise: jax.Array) -> jax.Array:
        return jax.vmap(lambda actor: act(policy.apply, actor, obs, noise))(loaded.actor)

    expected = np.asarray(learnt(jnp.asarray(obs), jnp.asarray(noise))).clip(env.action_low, env.action_high)
    assert expected.shape == (2, 1000, env.action_dim)
    np.testing.assert_array_equal(program.call(obs, noise), expected)
    assert program.call(obs[:7], noise[:7]).shape == (2, 7, env.action_dim)

    modes = np.stack([[one.mode(x) for x in obs] for one in policies(stored.config, loaded.actor, env)])
    np.testing.assert_allclose(modes, program.call(obs, 0 * noise), rtol=0, atol=1e-5)
    with np.load(files[0], allow_pickle=False) as arrays:
        assert arrays["kernel_0"].shape == (2, env.obs_dim, *stored.config.hidden_sizes[:1])
        np.testing.assert_array_equal(arrays["action_high"], np.broadcast_to(env.action_high, (2, env.action_dim)))

    with pytest.raises(SystemExit) as end:
        evaluate.main([f"{pipeline}/malm", "--export", "policy.pt"])
    assert end.value.code == 2
    assert "--export policy.pt: unknown kind of file" in capsys.readouterr().err


def test_numpy_policy_is_the_learnt_policy() -> None:
    import jax
    import jax.numpy as jnp

    from ccil_jax.acting import networks, running_statistics
    from ccil_jax.acting.rollout import Actor, act
    from experiments.policies.numpy_policy import NumpyPolicy

    random = np.random.default_rng(0)
    for activation in ("tanh", "relu", "swish"):
        config = Config(hidden_sizes=(16, 8), activation=activation)
        policy = networks.make_policy(config, 5, 3)
        statistics = running_statistics.update(running_statistics.init(5), jnp.asarray(random.normal(2, 3, (50, 5))))
        actor = Actor(policy_params=policy.init(jax.random.key(1)), obs_statistics=statistics)
        obs = random.normal(2, 10, (20, 5)).astype(np.float32)
        expected = act(policy.apply, actor, jnp.asarray(obs), jnp.zeros((20, 3)))
        numpy_policy = NumpyPolicy(config, actor, -np.ones(3), np.ones(3))
        np.testing.assert_allclose(np.stack([numpy_policy.mode(x) for x in obs]), expected, atol=1e-5)


def test_the_numpy_policy_of_iq_learn_is_the_jax_policy() -> None:
    import jax
    import jax.numpy as jnp

    import envs
    from ccil_jax.acting import networks
    from ccil_jax.acting.rollout import Actor, act
    from experiments.policies.numpy_policy import NumpyPolicy

    env = envs.make("Hopper")
    config = Config(method="iq_learn", hidden_sizes=(16, 8), activation="relu")
    policy = networks.make_squashed_policy(config, env)
    actor = Actor(policy_params=policy.init(jax.random.key(0)), obs_statistics=None)
    obs = np.random.default_rng(0).normal(0, 10, (20, 11)).astype(np.float32)
    noise = np.stack([np.random.default_rng(i).standard_normal(3) for i in range(20)]).astype(np.float32)
    numpy_policy = NumpyPolicy(config, actor, env.action_low, env.action_high)
    sampled = np.stack([numpy_policy.sample(x, np.random.default_rng(i)) for i, x in enumerate(obs)])
    expected = act(policy.apply, actor, jnp.asarray(obs), jnp.asarray(noise))
    np.testing.assert_allclose(sampled, expected, atol=1e-4)
    assert {"action_center", "action_half_range", "obs_clip"} <= numpy_policy.arrays().keys()


@pytest.mark.parametrize("task", ["Swimmer", "HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid"])
def test_original_episodes_are_scored_as_ours(task: str) -> None:
    """The same start and actions: return and cost of gymnasium's reports equal ours, summed step by step."""
    import jax

    import envs
    from experiments.policies import original_simulator

    env: Any = envs.make(task, physics="native", max_episode_steps=15)
    simulator = original_simulator.make_simulator(env)
    random = np.random.default_rng(3)
    actions = list(random.uniform(env.action_low, env.action_high, (15, env.action_dim)))
    rest = iter(actions)
    policy: Any = SimpleNamespace(sample=lambda obs, random: next(rest))
    steps = original_simulator.run_episode(simulator, policy, random, seed=5, deterministic=False)
    simulator.reset(seed=5)
    state = env.reset_to(simulator.unwrapped.data.qpos, simulator.unwrapped.data.qvel)
    total = np.zeros(2)
    step = jax.jit(env.step)
    for action in actions[: len(steps["control"])]:
        state = step(state, action.astype(np.float32))
        total += [state.reward, state.cost]
    assert bool(state.done)
    np.testing.assert_allclose(
        original_simulator.score(env, steps, contact_cost=True), [*total, len(steps["control"])], atol=1e-3
    )
    simulator.close()


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


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--unconstrained"], "is of method expert; leave --unconstrained out to resume it"),
        (["--multiplier-update", "sgd"], "--multiplier-update sgd: the run in"),
        (["--initial-multiplier", "3"], "--initial-multiplier 3.0: the run in"),
        (["--gamma", "0.5"], "--gamma 0.5: the run in"),
        (["--gate", "episode"], "--gate episode: makes no difference to this run of method expert"),
        (
            ["--multiplier-max", "3"],
            "--multiplier-max 3.0: the run in",
        ),  # it has ended: nothing would be trained with it
    ],
)
def test_what_an_expert_may_not_change_when_it_goes_on(
    pipeline: Path, tmp_path: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        expert.main(["--out", f"{tmp_path}/e.npz", "--run-dir", f"{pipeline}/expert", "--resume", *more])
    assert end.value.code == 2
    assert message in capsys.readouterr().err


def test_an_expert_goes_on_under_another_limit(pipeline: Path, tmp_path: Path) -> None:
    shutil.copytree(pipeline / "expert", tmp_path / "expert")
    made = ["--out", f"{tmp_path}/e.npz", "--run-dir", f"{tmp_path}/expert", "--resume"]
    more = ["--cost-limit", "19", "--multiplier-learning-rate", "0.5", "--max-kl", "0.001", "--env-steps", "360"]
    more += ["--cost-gamma", "0.5"]
    assert expert.main([*made, *more, "--num-trajectories", "2"]) == 0
    before, after = (read_metrics(folder / "expert") for folder in (pipeline, tmp_path))
    assert len(before["env_steps"]) < len(after["env_steps"])
    for name, rows in before.items():
        np.testing.assert_array_equal(after[name][: len(rows)], rows)
    config = run_folder.read_run(tmp_path / "expert").config
    assert (config.cost_limit, config.multiplier_learning_rate, config.max_kl) == (19.0, 0.5, 0.001)
    assert config.cost_gamma == 0.5
    facts = load_demonstrations(tmp_path / "e.npz").metadata
    assert (facts["cost_limit"], facts["limit_kept"]) == (19.0, True)
    assert len(facts["command"].splitlines()) == 2

    # Another limit alone takes no training: it says what is recorded. The run can still be read, and continued.
    assert expert.main([*made, "--overwrite", "--cost-limit", "18", "--num-trajectories", "2"]) == 0
    assert load_demonstrations(tmp_path / "e.npz").metadata["cost_limit"] == 18.0
    assert evaluate.main([f"{tmp_path}/expert", "--episodes", "2"]) == 0
    assert expert.main([*made, "--overwrite", "--env-steps", "480", "--num-trajectories", "2"]) == 0
    assert len(read_metrics(tmp_path / "expert")["env_steps"]) == 4


def test_a_resume_that_is_refused_leaves_the_run_as_it_was(
    pipeline: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(pipeline / "expert", tmp_path / "expert")
    for manifest in (tmp_path / "expert" / "checkpoints").glob("*/manifest.json"):
        manifest.write_text("{}")
    before = (tmp_path / "expert" / "config.json").read_bytes()
    with pytest.raises(SystemExit):
        expert.main(["--out", f"{tmp_path}/e.npz", "--run-dir", f"{tmp_path}/expert", "--resume", "--env-steps", "960"])
    assert "no other is intact" in capsys.readouterr().err
    assert (tmp_path / "expert" / "config.json").read_bytes() == before


def test_resume_refuses_other_demonstrations(
    pipeline: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from ccil_jax.demonstrations.trajectories import save_demonstrations

    save_demonstrations(tmp_path / "other.npz", load_demonstrations(pipeline / "expert.npz").take_episodes(2))
    with pytest.raises(SystemExit):
        train.main(["--resume", "--out", f"{pipeline}/malm", "--demos", f"{tmp_path}/other.npz"])
    assert "other.npz: not the file that the run" in capsys.readouterr().err


def test_no_seed_within_the_limit_is_a_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [{"seed": 0, "episode_return": 1.0, "episode_cost": 21.0}]
    rows = [{"seed": 0, "episode_return": 1.0, "episode_cost": 33.0}, {**rows[0], "seed": 1}]
    monkeypatch.setattr(expert, "execute", lambda plan: SimpleNamespace(summary={"per_seed": rows}))
    made = ["--env", "Swimmer", "--out", f"{tmp_path}/e.npz", "--run-dir", f"{tmp_path}/run", *TINY]
    assert expert.main([*made, "--cost-limit", "20", "--multiplier-learning-rate", "0.3"]) == 1
    said = capsys.readouterr().err
    assert "no seed keeps --cost-limit 20 (lowest cost 21)" in said
    advice = "--multiplier-learning-rate above the present 0.3 where the cost stays above the limit"
    assert advice in said
    remedy = f"evaluate {tmp_path}/run --record {tmp_path}/e.npz --seed-index 1 --num-trajectories 10"
    assert f"python -m experiments.{remedy}\n" in said
    assert expert.main([*made, "--cost-limit", "20", "--multiplier-update", "pid"]) == 1
    assert "multiplier-learning-rate" not in capsys.readouterr().err
    assert not (tmp_path / "e.npz").exists()
