"""The launchers `benchmark --peers` and `growth`, but for the speeds themselves."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from experiments import benchmark, growth, peers
from experiments.command_line import UsageError
from experiments.peers import Peer

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
    assert {s["num_envs"]: s["changes"]["batch_size"] for s in settings} == {16: 2000, 4096: 4096}


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

    monkeypatch.setattr(benchmark, "measure_row", measure_row)
    arguments = ["--axes", "seeds", "width", "--largest", "128", "--env", "Swimmer"]
    assert growth.main([*arguments, "--out", str(tmp_path / "g")]) == 0
    assert [s["num_seeds"] for s in measured] == [1, 2, 4, 8, 16, 32, 64, 1, 1, 1]
    assert [s["changes"].get("hidden_sizes") for s in measured[7:]] == [[32, 32], [64, 64], [128, 128]]
    content = json.loads((tmp_path / "g" / "growth.json").read_text())
    assert content["exponents"]["seeds"]["seconds_per_iteration"] == pytest.approx(2.0)
    assert content["exponents"]["width"]["peak_memory"] == pytest.approx(1.0)
    assert content["exponents"]["width"]["compile_seconds"] == pytest.approx(0.0, abs=1e-9)
    assert (tmp_path / "g" / "growth.png").stat().st_size > 10_000
