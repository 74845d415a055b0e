"""evaluation.json: no evaluation is lost, and no other file is taken for one."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from experiments.cli.command_line import UsageError
from experiments.runs import evaluations


def evaluation(cost: float, **changes: Any) -> dict[str, Any]:
    settings = {"run": "a", "simulator": "ours", "num_episodes": 50, "seed": 1, "deterministic": False}
    settings |= {"shared_episodes": False}
    return {**settings, **changes, "command": f"cost {cost}", "per_seed": [{"seed": 0, "episode_cost": cost}]}


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 2},
        {"num_episodes": 3},
        {"deterministic": True},
        {"shared_episodes": True},
        {"run": "b"},
        {"per_seed": []},
    ],
)
def test_what_differs_is_kept_aside(tmp_path: Path, change: dict[str, Any]) -> None:
    path = tmp_path / "evaluation.json"
    first, second = evaluation(1.0), evaluation(1.0) | change
    evaluations.add(path, first)
    assert evaluations.read(path) == {"ours": first}
    evaluations.add(path, second)
    assert evaluations.read(path) == {"ours": second, "earlier": [first]}
    original = evaluation(3.0, simulator="original")
    evaluations.add(path, original)
    assert evaluations.read(path) == {"ours": second, "original": original, "earlier": [first]}


def test_the_same_again_is_there_once(tmp_path: Path) -> None:
    path = tmp_path / "evaluation.json"
    for seed in (1, 2, 1, 1):
        evaluations.add(path, evaluation(float(seed), seed=seed) | {"command": "newest"})
    kept = evaluations.read(path)
    assert (kept["ours"]["seed"], [entry["seed"] for entry in kept["earlier"]]) == (1, [2])


def test_files_of_earlier_versions_are_kept_too(tmp_path: Path) -> None:
    path = tmp_path / "evaluation.json"
    old = {key: value for key, value in evaluation(1.0).items() if key not in ("run", "simulator")}
    path.write_text(json.dumps({"ours": old, "original": old}))
    evaluations.add(path, evaluation(2.0))
    kept = evaluations.read(path)
    assert kept["original"] == old
    assert kept["earlier"] == [{"simulator": "ours", **old}]


def test_evaluations_that_end_together_are_all_kept(tmp_path: Path) -> None:
    path = tmp_path / "evaluation.json"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda seed: evaluations.add(path, evaluation(float(seed), seed=seed)), range(16)))
    kept = evaluations.read(path)
    assert sorted(entry["seed"] for entry in [kept["ours"], *kept["earlier"]]) == list(range(16))


@pytest.mark.parametrize(
    "content",
    ["", "notes", "[]", '{"config": {}}', '{"ours": 3}', '{"ours": {}}', '{"earlier": {}}', '{"earlier": [1]}', "\xff"],
)
def test_other_files_are_refused_and_stay_as_they_are(tmp_path: Path, content: str) -> None:
    path = tmp_path / "results.json"
    path.write_text(content, encoding="latin-1")
    with pytest.raises(UsageError, match=r"--out .*results\.json: exists, and is not an intact file of evaluations"):
        evaluations.add(path, evaluation(1.0))
    assert path.read_text(encoding="latin-1") == content


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot be read \(Is a directory\)"):
        evaluations.read(tmp_path)
