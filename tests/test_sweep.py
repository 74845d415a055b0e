"""Sweeps: what is wrong with a spec, how it becomes programs, and one tiny sweep whose worker is killed."""

import json
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import run_folder, sweep, variants, workers
from experiments.command_line import UsageError
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
    "unknown method": ({"method": "mallm"}, "--method 'mallm': unknown; choose one of malm"),
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


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("s.yaml", "", "give a file named *.toml or *.json"),
        ("s.toml", "a = = 1", "not TOML (Invalid value (at line 1"),
        ("s.json", "{", "not JSON (Expecting property name"),
        ("s.json", "[]", "give a table with env, method"),
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
    grid = {**GRID, "max_kl": [0.01, 0.02, 0.05], "method": ["trpo", "expert"], "seed": [0, 1]}
    spec = {"env": "Swimmer", "fixed": FIXED, "grid": grid}
    found = sweep.variants_of(tmp_path / "s.json", spec, tmp_path)
    assert len(found) == 2 * 2 * 3 * 2 * 2
    programs = variants.group([variant for variant, _ in found.values()], tmp_path)
    assert [len(program.variants) for program in programs] == [2 * 3] * (2 * 2 * 2)  # sizes, methods, base seeds
    assert len({program.folder for program in programs}) == 8


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
        wanted = {"experiments.sweep_worker", str(folder)}
        return [pid for pid, words in command_lines().items() if wanted <= set(words)]


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
        assert run_folder.read_metrics(folder)["episode_cost"].shape == (2, 2)
        assert run_folder.read_json(folder / "summary.json")["runs_in_program"] == 4
    # Both learning rates see the same first batch, and answer it differently.
    slow, fast = (
        run_folder.read_metrics(out / "runs" / f"multiplier_learning_rate={rate},hidden_sizes=4") for rate in GRID_RATES
    )
    np.testing.assert_array_equal(slow["episode_return"][0], fast["episode_return"][0])
    assert (slow["multiplier"][-1] != fast["multiplier"][-1]).all()

    # Interrupted: what is finished stays as it is, what is not is finished.
    missing = out / "runs" / "multiplier_learning_rate=0.5,hidden_sizes=4" / "summary.json"
    missing.unlink()
    others = {path: path.stat().st_mtime_ns for path in out.glob("runs/*/summary.json")}
    assert sweep.main([str(spec), "--out", str(out), "--resume"]) == 0
    assert "in 2 programs, 1 of them unfinished" in capsys.readouterr().out
    assert missing.exists()
    assert {path: path.stat().st_mtime_ns for path in others} == others

    for changes, message in (({"method": "trpo"}, "--resume: method is 'trpo'"), ({"fixed": FIXED | {"seed": 1}}, "")):
        with pytest.raises(SystemExit):
            sweep.main([str(write_spec(tmp_path, "other.json", **changes)), "--out", str(out), "--resume"])
        assert message in capsys.readouterr().err


def broken_program(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "program.json").write_text("{}")
    return folder


def test_a_program_that_fails_is_reported(tmp_path: Path) -> None:
    folders = [broken_program(tmp_path / "programs" / name) for name in "ab"]
    outcomes = dict(workers.in_processes(folders, num_workers=2))
    assert set(outcomes) == set(folders)
    for folder, failure in outcomes.items():
        assert failure is not None
        assert failure.startswith("exit status 2: python -m experiments.sweep_worker: error:")
        assert failure.endswith(f"damaged; repeat the sweep in another folder ({folder / 'worker.log'})")


def small_program(out: Path) -> Path:
    fields = {**SPEC["fixed"], "env": "Swimmer", "method": "trpo", "hidden_sizes": [4]}
    (program,) = variants.group([variants.make_variant("trpo", fields, out)], out)
    variants.write_program(program)
    return program.folder


def test_ray_places_programs_on_a_cluster_of_two_nodes(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="the extra ray is not installed")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    folders = [small_program(tmp_path), broken_program(tmp_path / "programs" / "broken")]
    os.environ["RAY_ADDRESS"] = cluster.address
    try:
        outcomes = dict(workers.on_ray(folders, num_workers=2))
    finally:
        del os.environ["RAY_ADDRESS"]
        cluster.shutdown()
    assert outcomes[folders[0]] is None
    assert "exit status 2" in str(outcomes[folders[1]])
    assert (tmp_path / "runs" / "trpo" / "summary.json").exists()


def test_submitit_carries_programs_out(tmp_path: Path) -> None:
    """Where there is no SLURM, submitit's executor starts the same jobs on this machine."""
    pytest.importorskip("submitit", reason="the extra slurm is not installed")
    folders = [small_program(tmp_path), broken_program(tmp_path / "programs" / "broken")]
    outcomes = dict(workers.on_slurm(folders, 2, tmp_path / "slurm", {"timeout_min": 10}))
    assert outcomes[folders[0]] is None
    assert "exit status 2" in str(outcomes[folders[1]])
    assert (tmp_path / "runs" / "trpo" / "summary.json").exists()


def die_once(folder: Path) -> None:
    """In place of a worker: killed at the first try, and where the folder is called `always` at every try."""
    died = (folder / "died").exists()
    (folder / "died").touch()
    if folder.name == "always" or not died:
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_lost_slurm_job_is_replaced_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit", reason="the extra slurm is not installed")
    monkeypatch.setattr(workers, "run_worker", die_once)
    folders = [tmp_path / name for name in ("once", "always")]
    for folder in folders:
        folder.mkdir()
    outcomes = dict(workers.on_slurm(folders, 2, tmp_path / "slurm", {"timeout_min": 10}))
    assert outcomes[folders[0]] is None
    assert str(outcomes[folders[1]]).startswith("lost by SLURM: job ")
    assert str(tmp_path / "slurm") in str(outcomes[folders[1]])


@pytest.mark.parametrize(("launcher", "package"), [("ray", "ray"), ("slurm", "submitit")])
def test_a_missing_extra_is_named(launcher: str, package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(workers.UsageError, match=rf"{package} is not installed; pip install 'ccil_jax\[{launcher}\]'"):
        workers.check_launcher(launcher)
    workers.check_launcher("processes")
