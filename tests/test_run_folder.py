"""The files of a run folder: one row per iteration and seed, strict JSON, nothing twice after a resumption."""

import csv
import errno
import json
from pathlib import Path

import numpy as np
import pytest

from experiments import run_folder
from experiments.command_line import UsageError


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
    """Killed in the middle of a line, iterations after the last checkpoint, that of iteration 2."""
    with run_folder.MetricsWriter(tmp_path) as writer:
        writer.begin({})
        writer.write(4, metrics(4))
    path = tmp_path / "metrics.csv"
    whole = path.read_text()
    path.write_text(whole[:-5])
    with run_folder.MetricsWriter(tmp_path) as writer:
        writer.begin(metrics(2))
        writer.write(3, metrics(1, first=2))
        writer.write(4, metrics(1, first=3))
    assert path.read_text() == whole


def test_counters_pass_31_bits(tmp_path: Path) -> None:
    """Nine digits would do for float32, not for steps."""
    with run_folder.MetricsWriter(tmp_path) as writer:
        writer.begin({})
        writer.write(1, {"env_steps": np.array([[2**31 + 1]])})
    assert (tmp_path / "metrics.csv").read_text().splitlines() == ["iteration,seed,env_steps", "1,0,2147483649"]
    assert run_folder.read_metrics(tmp_path)["env_steps"].item() == 2**31 + 1


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


def test_a_full_disk_is_told_with_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with run_folder.MetricsWriter(tmp_path) as writer:
        writer.begin({})
        monkeypatch.setattr(writer._events, "write_event", full)
        with pytest.raises(OSError, match="No space left") as caught:
            writer.write(1, {"env_steps": np.full((1, 2), 64), "kl": np.zeros((1, 2))})
    assert caught.value.filename == str(tmp_path)
