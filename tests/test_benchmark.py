"""The launchers `benchmark --peers` and `growth`, but for the speeds themselves."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from experiments import benchmark, growth
from experiments.cli.command_line import UsageError
from experiments.speed import peers, row_processes, tables
from experiments.speed.locks import file_lock
from experiments.speed.peers import Peer
from tests.processes import command_lines, in_proc

SCRIPT = """
import json, pathlib, sys
calls = pathlib.Path(__file__).with_name("calls")
calls.write_text((calls.read_text() if calls.exists() else "") + sys.argv[1])
print("noise")
print(json.dumps({"steps_per_second": float(sys.argv[2]) * len(calls.read_text()), "versions": {"numpy": "1"}}))
"""


def test_peers_are_timed_before_and_after_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    peer = Peer("A peer", "script.py", {"slow": ("a", "1"), "fast": ("b", "10")}, "Swimmer", "gail")
    monkeypatch.setattr(peers, "_FOLDER", tmp_path)
    monkeypatch.setattr(peers, "PEERS", {"a": peer})
    asked = []

    def measure(peer: Peer, seeds: int) -> dict[str, Any]:
        asked.append((peer.task, peer.method, seeds, (tmp_path / "calls").read_text()))
        return {"training_steps_per_second": 300.0 * seeds}

    (row,) = peers.compare({"a": Path(sys.executable)}, measure)
    assert asked == [("Swimmer", "gail", 1, "ab"), ("Swimmer", "gail", 8, "ab")]
    assert (tmp_path / "calls").read_text() == "abab"
    assert row["ways"] == {"slow": [1.0, 3.0], "fast": [20.0, 40.0]}
    assert row["best_steps_per_second"] == 30.0
    assert row["ratio"] == {1: 10.0, 8: 80.0}
    assert row["versions"] == {"numpy": "1"}


def test_a_peer_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "script.py").write_text("import a_package_that_is_not_there")
    monkeypatch.setattr(peers, "_FOLDER", tmp_path)
    monkeypatch.setattr(peers, "PEERS", {"a": Peer("A peer", "script.py", {"way": ()}, "Swimmer", "gail")})
    with pytest.raises(UsageError, match=r"script\.py in .* failed: ModuleNotFoundError: .*a_package"):
        peers.compare({"a": Path(sys.executable)}, lambda *_: {})


def test_rows_are_all_sizes_of_all_tasks() -> None:
    arguments = ["--tasks", "Swimmer", "Ant", "--num-seeds", "1", "32", "--num-envs", "16", "4096", "--preset", "paper"]
    settings = benchmark.settings_of(benchmark.make_parser().parse_args(arguments))
    assert [(s["task"], s["num_seeds"], s["num_envs"]) for s in settings] == [
        (task, seeds, envs) for task in ("Swimmer", "Ant") for seeds in (1, 32) for envs in (16, 4096)
    ]
    # Many simulations fill a larger batch, in as many minibatches: here 32 times the preset's 2000 in 128s.
    small = {"batch_size": 2000, "critic_minibatch_size": 128, "discriminator_minibatch_size": 128}
    large = {"batch_size": 65536, "critic_minibatch_size": 4096, "discriminator_minibatch_size": 4096}
    assert {s["num_envs"]: s["changes"] for s in settings} == {16: small, 4096: large}


def test_batches_of_any_number_of_simulations_are_whole_steps_of_each() -> None:
    for num_envs in (1, 16, 24, 125, 126, 1024, 3000):
        changes = benchmark._batch("paper", num_envs, None)
        assert changes["batch_size"] % num_envs == 0
        assert changes["batch_size"] >= max(2000, 16 * num_envs)
    assert benchmark._batch("paper", 16, 192)["batch_size"] == 192


def test_rows_that_fail_do_not_spoil_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, turns = tmp_path / "benchmark.json", set()

    def measure_row(setting: dict[str, Any], launcher: str, *options: str) -> dict[str, Any]:
        turns.add(setting["turns"])
        if setting["num_envs"] == 32:
            raise UsageError("--num-envs 32: cannot be measured: out of memory")
        if setting["num_envs"] == 16:  # the first to be asked for is the last to come: nothing waits for it
            while not (out.is_file() and len(json.loads(out.read_text())["rows"]) == 1):
                time.sleep(0.01)
        return {"num_envs": setting["num_envs"]}

    monkeypatch.setattr(row_processes, "measure_row", measure_row)
    monkeypatch.setattr(tables, "print_rows", lambda rows: print([row["num_envs"] for row in rows]))
    sizes = ["--num-seeds", "1", "--num-envs", "16", "32", "64"]
    with pytest.raises(SystemExit) as end:
        benchmark.main(["--tasks", "Swimmer", *sizes, "--jobs", "3", "--out", str(out)])
    assert end.value.code == 2
    said = capsys.readouterr()
    assert said.out.strip() == "[16, 64]"
    assert "out of memory" in said.err
    assert [row["num_envs"] for row in json.loads(out.read_text())["rows"]] == [16, 64]
    assert len(turns) == 1


@in_proc
def test_a_row_ends_with_whoever_waits_for_it(tmp_path: Path) -> None:
    def runs() -> bool:
        return any("--row" in words and '"seed": 271828' in words[-2] for words in command_lines().values())

    command = [sys.executable, "-m", "experiments.benchmark", "--tasks", "Swimmer", "--num-seeds", "1"]
    command += ["--seed", "271828", "--out", str(tmp_path / "b.json")]
    deadline = time.monotonic() + 60
    ears, mouth = os.pipe()
    with open(ears, "rb") as stdin, open(mouth, "wb"):  # not this is what ends
        process = subprocess.Popen(command, stdin=stdin, stderr=subprocess.DEVNULL)
        while not runs():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        process.kill()
        process.wait()
        while runs():
            assert time.monotonic() < deadline
            time.sleep(0.1)


def test_who_measures_is_alone(tmp_path: Path) -> None:
    file = str(tmp_path / "turns")
    wait = threading.Event()

    def measure() -> None:
        with file_lock(file, exclusive=True):
            wait.set()

    with file_lock(file, exclusive=False), file_lock(file, exclusive=False):  # they compile side by side
        thread = threading.Thread(target=measure)
        thread.start()
        assert not wait.wait(0.3)
    thread.join(5)
    assert wait.is_set()
    with file_lock(None, exclusive=True), file_lock(None, exclusive=True):
        pass


def test_missing_environments_of_peers_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        benchmark.main(["--peers", str(tmp_path), "--out", str(tmp_path / "benchmark.json")])
    assert end.value.code == 2
    assert f"--peers {tmp_path}: no imitation/bin/python; make the environments" in capsys.readouterr().err


def test_an_exponent_is_the_slope_of_the_larger_half() -> None:
    sizes = [1, 2, 4, 8, 16, 32]
    assert growth.exponent(sizes, [7, 7, 7, *(x**1.5 for x in sizes[3:])]) == pytest.approx(1.5)


def test_growth_measures_one_axis_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured = []

    def measure_row(setting: dict[str, Any], launcher: str) -> dict[str, Any]:
        assert launcher == "growth"
        measured.append(setting)
        size = setting["num_seeds"] * setting["changes"].get("hidden_sizes", [64])[0]
        return {
            "task": setting["task"],
            "seconds_per_iteration": 2.0 * size**2,
            "compile_seconds": 3.0,
            "peak_memory": 10.0 * size,
            "training_steps_per_second": 1.0,
        }

    monkeypatch.setattr(row_processes, "measure_row", measure_row)
    arguments = ["--axes", "seeds", "width", "--largest", "128", "--env", "Swimmer"]
    assert growth.main([*arguments, "--out", str(tmp_path / "g")]) == 0
    assert [s["num_seeds"] for s in measured] == [1, 2, 4, 8, 16, 32, 64, 1, 1, 1]
    assert [s["changes"].get("hidden_sizes") for s in measured[7:]] == [[32, 32], [64, 64], [128, 128]]
    content = json.loads((tmp_path / "g" / "growth.json").read_text())
    assert content["exponents"]["seeds"]["seconds_per_iteration"] == pytest.approx(2.0)
    assert content["exponents"]["width"]["peak_memory"] == pytest.approx(1.0)
    assert content["exponents"]["width"]["compile_seconds"] == pytest.approx(0.0, abs=1e-9)
    assert (tmp_path / "g" / "growth.png").stat().st_size > 10_000
