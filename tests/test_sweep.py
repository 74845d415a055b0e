"""Sweeps: what is wrong with a spec, how it becomes programs, and one tiny sweep whose worker is killed."""

import hashlib
import json
import os
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import envs
from ccil_jax.demonstrations.trajectories import Demonstrations, save_demonstrations
from ccil_jax.training import manifests, runner
from experiments import sweep
from experiments.cli.command_line import UsageError
from experiments.runs import run_folder
from experiments.runs.metrics_file import read_metrics
from experiments.sweeps import backends, machine, variants, worker
from tests.probe_envs import Walk, quick_compilation, same_bits, walk_config
from tests.processes import command_lines, in_proc

FIXED = {"preset": "tiny", "num_seeds": 2, "max_episode_steps": 20, "eval_episodes": 3, "cost_limit": 5.0}
SPEC: dict[str, Any] = {"env": "Swimmer", "method": "expert", "fixed": FIXED}
GRID_RATES = [0.01, 0.5]
GRID = {"multiplier_learning_rate": GRID_RATES, "hidden_sizes": [[4], [8, 8]]}


def write_spec(folder: Path, name: str = "spec.json", **changes: Any) -> Path:
    path = folder / name
    path.write_text(json.dumps({**SPEC, "grid": GRID, **changes}))
    return path


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "unknown key": ({"methods": ["malm"]}, "'methods': unknown; give env, method,"),
    "unknown field": ({"grid": {"gama": [0.9]}}, "--gama: unknown; did you mean --gamma?"),
    "fixed unknown field": ({"fixed": {"out": "x"}}, "--out: unknown"),
    "unknown method": ({"method": "mallm"}, "--method 'mallm': unknown; did you mean malm? choose one of malm"),
    "unknown task": ({"grid": {**GRID, "env": ["Swimer"]}, "env": None}, "grid.env: also given outside of the grid"),
    "misspelt task": ({"env": "Swimer"}, "--env Swimer: unknown task; did you mean Swimmer?"),
    "empty grid": ({"grid": {}}, "grid: empty"),
    "no values": ({"grid": {"gamma": []}}, "grid.gamma: give a list of at least one value"),
    "one value": ({"grid": {"gamma": 0.9}}, "grid.gamma: give a list of at least one value"),
    "value twice": ({"grid": {"gamma": [0.9, 0.9]}}, "grid.gamma: the same value twice"),
    "wrong type": ({"grid": {"gamma": ["high"]}}, "--gamma: invalid float value: 'high'"),
    "wrong list": ({"grid": {"gamma": [[0.9, 0.8]]}}, "--gamma: invalid float value: '0.9,0.8'"),
    "wrong integer": ({"grid": {"num_envs": [1.5]}}, "--num-envs: invalid integer value"),
    "out of range": ({"grid": {"max_kl": [0.01, 0]}}, "--max-kl 0"),
    "not a table": ({"grid": [1]}, "grid: give a table of fields"),
    "two spellings": ({"fixed": {**FIXED, "num-seeds": 3}}, "fixed.num_seeds: given twice; leave one out"),
    "env twice": ({"fixed": {**FIXED, "env": "Hopper"}}, "fixed.env: given twice"),
    "no file": ({"fixed": {**FIXED, "demos": 5}}, "--demos 5: give the name of a file"),
    "no text": ({"fixed": {**FIXED, "demos": "a\0b"}}, "--demos 'a"),
    "same run twice": ({"grid": {"gamma": [0.9, "0.90"]}}, "gamma=0.90 is the same run as gamma=0.9; leave one"),
    "no effect": ({"grid": {"gate": ["batch", "episode"]}}, "--gate batch: makes no difference to this run of method"),
    "limit missing": ({"fixed": {"preset": "tiny"}}, "--cost-limit: method expert needs"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_spec_is_one_line(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes, message = WRONG[case]
    path = write_spec(tmp_path, **changes)
    with pytest.raises(SystemExit) as end:
        sweep.main([str(path), "--out", str(tmp_path / "out")])
    error = capsys.readouterr().err
    assert end.value.code == 2
    assert error.count("\n") == 1
    assert f"SPEC {path}: " in error
    assert message in error
    assert not (tmp_path / "out").exists()


def test_points_that_would_share_a_folder_are_refused(tmp_path: Path) -> None:
    files = [tmp_path / "a" / "b.npz", tmp_path / "a_b.npz"]
    for seed, file in enumerate(files):
        save_demonstrations(file, swimmer_demonstrations(seed))
    grid = {"demos": [str(file) for file in files]}
    spec = {"env": "Swimmer", "method": "gail", "fixed": {"preset": "tiny"}, "grid": grid}
    with pytest.raises(UsageError, match=r"grid: two points would share the folder demos=.*a_b\.npz; rename"):
        sweep.variants_of(tmp_path / "s.json", spec, tmp_path)


def swimmer_demonstrations(seed: int) -> Demonstrations:
    random, last = np.random.default_rng(seed), np.arange(20) == 19
    return Demonstrations(
        obs=random.normal(size=(20, 8)).astype(np.float32),
        actions=random.uniform(-1, 1, (20, 2)).astype(np.float32),
        rewards=None,
        costs=np.ones(20, np.float32),
        terminated=np.zeros(20, bool),
        truncated=last,
        episode_ends=np.array([20]),
    )


def test_variants_share_what_they_read(tmp_path: Path) -> None:
    spec = {"env": "Swimmer", "method": "ccil", "fixed": {"preset": "tiny"}, "grid": {"gamma": [0.9, 0.99]}}
    found = sweep.variants_of(tmp_path / "s.json", spec, tmp_path)
    one, other = (variant.plan.setup.demonstrations for variant, _ in found.values())
    assert one is not None
    assert one is other


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("s.yaml", "", "give a file named *.toml or *.json"),
        ("s.toml", "a = = 1", "not TOML (Invalid value (at line 1"),
        ("s.json", "{", "not JSON (Expecting property name"),
        ("s.json", '{"grid": {"seed": [1, 2], "seed": [3]}}', "not JSON ('seed' is there twice)"),
        ("s.json", "[]", "give a table of fields"),
        ("s.json", "[" * 100_000, "nested too deeply"),
    ],
)
def test_a_damaged_spec_is_one_line(
    name: str, content: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(SystemExit) as end:
        sweep.main([str(tmp_path / name), "--out", str(tmp_path / "out")])
    assert end.value.code == 2
    assert message in capsys.readouterr().err


def test_toml_and_json_are_the_same(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text('env = "Swimmer"\nmethod = "expert"\n[grid]\ngamma = [0.9, 1]\n')
    (tmp_path / "s.json").write_text('{"env": "Swimmer", "method": "expert", "grid": {"gamma": [0.9, 1]}}')
    assert sweep.read_spec(tmp_path / "s.toml") == sweep.read_spec(tmp_path / "s.json")


def test_a_byte_order_mark_does_not_matter_and_other_encodings_are_named(tmp_path: Path) -> None:
    texts = {
        "s.toml": 'env = "Swimmer"\n[grid]\ngamma = [0.9, 1]\n',
        "s.json": '{"env": "Swimmer", "grid": {"gamma": [0.9, 1]}}',
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
        assert sweep.read_spec(tmp_path / name) == {"env": "Swimmer", "fixed": {}, "grid": {"gamma": [0.9, 1]}}
        (tmp_path / name).write_text(text, encoding="utf-16")
        with pytest.raises(UsageError, match=rf"SPEC .*{name}: not text in UTF-8; save it with that encoding"):
            sweep.read_spec(tmp_path / name)


def test_static_fields_make_programs_and_traced_fields_share_them(tmp_path: Path) -> None:
    grid = {**GRID, "max_kl": [0.01, 0.02, 0.05], "multiplier_update": ["adam", "sgd"], "seed": [0, 1]}
    spec = {"env": "Swimmer", "method": "expert", "fixed": FIXED, "grid": grid}
    found = sweep.variants_of(tmp_path / "s.json", spec, tmp_path)
    assert len(found) == 2 * 2 * 3 * 2 * 2
    jobs = variants.group([variant for variant, _ in found.values()], tmp_path)
    assert [len(job.variants) for job in jobs] == [2 * 3] * (2 * 2 * 2)  # sizes, dual steps, base seeds
    assert len({job.folder for job in jobs}) == 8


class Killer(threading.Thread):
    """Kills the first worker that has written a checkpoint."""

    def __init__(self, out: Path) -> None:
        super().__init__(daemon=True)
        self.out = out
        self.killed: str | None = None  # name of its program's folder

    def run(self) -> None:
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline:
            for metrics in self.out.glob("programs/*/checkpoints/[0-9]*"):
                folder = metrics.parent.parent
                for process in self._workers(folder):
                    os.kill(process, signal.SIGKILL)
                    self.killed = folder.name
                    return
            time.sleep(0.02)

    @staticmethod
    def _workers(folder: Path) -> list[int]:
        wanted = {"experiments.sweeps.worker", str(folder)}
        return [pid for pid, words in command_lines().items() if wanted <= set(words)]


@pytest.mark.once
@in_proc
def test_a_sweep_survives_a_killed_worker_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")  # in the workers: their programs compile sooner
    spec, out = write_spec(tmp_path), tmp_path / "out"
    killer = Killer(out)
    killer.start()
    assert sweep.main([str(spec), "--out", str(out), "--workers", "2"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("4 variants, 8 runs, in 2 programs\n")
    assert killer.killed is not None
    log = (out / "programs" / killer.killed / "worker.log").read_text()
    assert log.count("compiling ...") == 2  # two workers, of which
    assert 1 <= log.count("compiled in") <= 2  # the second had iterations left if the first died while it saved

    rows = (out / "sweep.csv").read_text().splitlines()
    assert len(rows) == 1 + 4
    assert (out / "sweep.png").read_bytes().startswith(b"\x89PNG")
    for name in ("multiplier_learning_rate=0.01,hidden_sizes=4", "multiplier_learning_rate=0.5,hidden_sizes=8,8"):
        folder = out / "runs" / name
        assert {"config.json", "metrics.csv", "summary.json", "checkpoints"} <= {p.name for p in folder.iterdir()}
        assert read_metrics(folder)["episode_cost"].shape == (2, 2)
        assert run_folder.read_json(folder / "summary.json")["runs_in_program"] == 4
    # Both learning rates see the same first batch, and answer it differently.
    slow, fast = (read_metrics(out / "runs" / f"multiplier_learning_rate={rate},hidden_sizes=4") for rate in GRID_RATES)
    np.testing.assert_array_equal(slow["episode_return"][0], fast["episode_return"][0])
    assert (slow["multiplier"][-1] != fast["multiplier"][-1]).all()

    checkpoints_agree_with_metrics(out)

    # Interrupted: what is finished stays as it is, what is not is finished, from the checkpoints of its program.
    folder = out / "runs" / "multiplier_learning_rate=0.5,hidden_sizes=4"
    before, scores = read_metrics(folder), run_folder.read_json(folder / "summary.json")["per_seed"]
    (folder / "summary.json").unlink()
    others = {
        path: path.stat().st_mtime_ns
        for path in out.glob("runs/*/**/*")
        if path.is_file() and folder not in path.parents
    }
    assert sweep.main([str(spec), "--out", str(out), "--resume"]) == 0
    assert "in 2 programs, 1 of them unfinished" in capsys.readouterr().out
    # Whatever is evaluated beside it, a run plays the same episodes.
    for again, row in zip(run_folder.read_json(folder / "summary.json")["per_seed"], scores, strict=True):
        assert again["episode_return"] == pytest.approx(row["episode_return"], rel=1e-4)
        assert again["episode_cost"] == row["episode_cost"]
    program = next(iter(out.glob("programs/*")))
    log = (program / "worker.log").read_text()
    assert worker.main([str(program)]) == 0  # nothing is left to do
    assert (program / "worker.log").read_text() == log
    assert {path: path.stat().st_mtime_ns for path in others} == others
    assert sorted(path.name for path in (folder / "checkpoints").glob("[0-9]*")) == ["2"]
    after = read_metrics(folder)
    assert all(np.array_equal(before[name], after[name], equal_nan=True) for name in before)
    checkpoints_agree_with_metrics(out)

    for changes, message in (
        ({"env": "HalfCheetah"}, "--resume: env is 'HalfCheetah'"),
        ({"fixed": FIXED | {"seed": 1}}, ""),
    ):
        with pytest.raises(SystemExit):
            sweep.main([str(write_spec(tmp_path, "other.json", **changes)), "--out", str(out), "--resume"])
        assert message in capsys.readouterr().err


def checkpoints_agree_with_metrics(out: Path) -> None:
    """Every variant's own checkpoint can be loaded, and holds the run that its metrics tell of."""
    for folder in out.glob("runs/*"):
        run = run_folder.read_run(folder)
        env = envs.make("Swimmer", **run.facts["env_options"])
        assert jax.tree.leaves(runner.load(run.config, env, folder / "checkpoints", 2).actor)
        saved = manifests.read(folder / "checkpoints" / "2")["arrays"]
        metrics = read_metrics(folder)
        assert {name for name in saved if name.startswith("history.")} == {f"history.{name}" for name in metrics}
        for name, rows in metrics.items():  # nine digits are enough for a float32 number
            fact = saved[f"history.{name}"]
            assert hashlib.sha256(rows.astype(fact["dtype"]).tobytes()).hexdigest() == fact["sha256"], name


def test_a_run_that_another_program_left_is_set_aside_whole(tmp_path: Path) -> None:
    """As where a version before this one grouped what was unfinished anew, and trained it to the same step."""
    with quick_compilation():
        old, new = (
            runner.train(walk_config(method="trpo", gamma=gamma, env_steps=64), Walk()) for gamma in (0.9, 0.99)
        )
    runner.save(old, tmp_path)
    runner.save(old, tmp_path)  # the same run: nothing to do
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1"]
    runner.save(new, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "1.replaced"]
    assert same_bits(runner.load(new.config, Walk(), tmp_path, 1).actor, new.actor)


def test_a_stopped_sweep_starts_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stopping = threading.Event()
    stopping.set()
    assert backends.run_worker(tmp_path, stopping=stopping) == "stopped before it began"
    assert list(tmp_path.iterdir()) == []

    begun = []

    def work(folder: Path, cpus: Any, stopping: threading.Event, variables: Any) -> str | None:
        begun.append(folder.name)
        if folder.name != "a":
            assert stopping.wait(60)
        return None

    monkeypatch.setattr(backends, "run_worker", work)
    outcomes = backends.in_processes([Path(name) for name in "abc"], num_workers=1)
    assert next(outcomes) == (Path("a"), None)
    while begun != ["a", "b"]:
        time.sleep(0.01)
    outcomes.close()
    assert begun == ["a", "b"]


def test_workers_share_the_gpus_of_a_machine() -> None:
    fraction = "XLA_PYTHON_CLIENT_MEM_FRACTION"
    assert machine.gpu_share(0, 4, [], {}) == {}
    assert machine.gpu_share(0, 1, ["0", "1"], {}) == {}  # a worker alone has them all
    assert [machine.gpu_share(i, 2, ["0", "7"], {}) for i in range(2)] == [
        {"CUDA_VISIBLE_DEVICES": "0"},
        {"CUDA_VISIBLE_DEVICES": "7"},
    ]
    assert [machine.gpu_share(i, 3, ["0", "1"], {}) for i in range(3)] == [
        {"CUDA_VISIBLE_DEVICES": gpu, fraction: "0.400"} for gpu in ("0", "1", "0")
    ]
    own = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    assert machine.gpu_share(1, 3, ["0"], own) == {"CUDA_VISIBLE_DEVICES": "0"}


def test_gpus_are_those_that_the_user_lets_a_process_see(tmp_path: Path) -> None:
    assert machine.visible_gpus({}, driver=tmp_path / "none") == []
    for name in ("0000:01:00.0", "0000:02:00.0"):
        (tmp_path / name).mkdir()
    assert machine.visible_gpus({}, driver=tmp_path) == ["0", "1"]
    assert machine.visible_gpus({"CUDA_VISIBLE_DEVICES": "3,GPU-5"}, driver=tmp_path) == ["3", "GPU-5"]
    assert machine.visible_gpus({"CUDA_VISIBLE_DEVICES": ""}, driver=tmp_path) == []


def test_settings_of_slurm_are_refused_where_slurm_is_not_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        sweep.main([str(write_spec(tmp_path)), "--out", str(tmp_path / "out"), "--slurm", "timeout_min=5"])
    assert end.value.code == 2
    assert "--slurm: --launcher processes does not use it; leave it out" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_row_of_the_table_is_a_launcher(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    launched = []

    def launch(folders: Sequence[Path], num_workers: int, logs: Path, settings: Mapping[str, Any]) -> backends.Outcomes:
        launched.append((len(folders), num_workers, logs, settings))
        return ((folder, "the machine is gone") for folder in folders)

    rows = {**backends.BACKENDS, "mine": backends.Backend(launch=launch, settings="whatever it takes")}
    monkeypatch.setattr(backends, "BACKENDS", rows)
    given = [str(write_spec(tmp_path)), "--out", str(tmp_path / "out"), "--workers", "3", "--launcher", "mine"]
    with pytest.raises(SystemExit):
        sweep.main([*given, "--mine", "minutes=5", "queue=fast"])
    assert launched == [(2, 3, tmp_path / "out" / "mine", {"minutes": 5, "queue": "fast"})]
    said = capsys.readouterr()
    assert "FAILED (the machine is gone)" in said.out
    assert "no variant was finished" in said.err
    given[-1] = "ray"
    monkeypatch.setattr(backends.importlib.util, "find_spec", lambda name: object())
    with pytest.raises(SystemExit):
        sweep.main([*given, "--mine", "minutes=5"])
    assert "--mine: --launcher ray does not use it; leave it out, or add --launcher mine" in capsys.readouterr().err


def broken_program(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "program.json").write_text("{}")
    return folder


def test_a_program_that_fails_is_reported(tmp_path: Path) -> None:
    folders = [broken_program(tmp_path / "programs" / name) for name in "ab"]
    outcomes = dict(backends.in_processes(folders, num_workers=2))
    assert set(outcomes) == set(folders)
    for folder, failure in outcomes.items():
        assert failure is not None
        assert failure.startswith("exit status 2: python -m experiments.sweeps.worker: error:")
        assert failure.endswith(f"damaged; repeat the sweep in another folder ({folder / 'worker.log'})")


def small_program(out: Path) -> Path:
    fields = {**SPEC["fixed"], "env": "Swimmer", "method": "expert", "hidden_sizes": [4]}
    (job,) = variants.group([variants.make_variant("expert", fields, out)], out)
    variants.write_job(job)
    return job.folder


def test_ray_places_programs_on_a_cluster_of_two_nodes(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="the extra ray is not installed")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    folders = [small_program(tmp_path), broken_program(tmp_path / "programs" / "broken")]
    os.environ["RAY_ADDRESS"] = cluster.address
    try:
        outcomes = dict(backends.on_ray(folders, num_workers=2))
    finally:
        del os.environ["RAY_ADDRESS"]
        cluster.shutdown()
    assert outcomes[folders[0]] is None
    assert "exit status 2" in str(outcomes[folders[1]])
    assert (tmp_path / "runs" / "expert" / "summary.json").exists()


def test_submitit_carries_programs_out(tmp_path: Path) -> None:
    """Where there is no SLURM, submitit's executor starts the same jobs on this machine."""
    pytest.importorskip("submitit", reason="the extra slurm is not installed")
    folders = [small_program(tmp_path), broken_program(tmp_path / "programs" / "broken")]
    outcomes = dict(backends.on_slurm(folders, 2, tmp_path / "slurm", {"timeout_min": 10}))
    assert outcomes[folders[0]] is None
    assert "exit status 2" in str(outcomes[folders[1]])
    assert (tmp_path / "runs" / "expert" / "summary.json").exists()


def die_once(folder: Path) -> None:
    """In place of a worker: killed at the first try, and where the folder is called `always` at every try."""
    died = (folder / "died").exists()
    (folder / "died").touch()
    if folder.name == "always" or not died:
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_lost_slurm_job_is_replaced_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit", reason="the extra slurm is not installed")
    monkeypatch.setattr(backends, "run_worker", die_once)
    folders = [tmp_path / name for name in ("once", "always")]
    for folder in folders:
        folder.mkdir()
    outcomes = dict(backends.on_slurm(folders, 2, tmp_path / "slurm", {"timeout_min": 10}))
    assert outcomes[folders[0]] is None
    assert str(outcomes[folders[1]]).startswith("lost by SLURM: job ")
    assert str(tmp_path / "slurm") in str(outcomes[folders[1]])


@pytest.mark.parametrize(("launcher", "package"), [("ray", "ray"), ("slurm", "submitit")])
def test_a_missing_extra_is_named(launcher: str, package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(backends.UsageError, match=rf"{package} is not installed; pip install 'ccil_jax\[{launcher}\]'"):
        backends.check_launcher(launcher)
    backends.check_launcher("processes")
