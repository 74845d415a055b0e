"""The demonstrations' arithmetic, the file's round trip, and every defect that a file can have."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccil_jax.demonstrations.trajectories import (
    Demonstrations,
    check_matches,
    check_time_limit,
    load_demonstrations,
    save_demonstrations,
)
from ccil_jax.errors import DemonstrationsError
from experiments import train
from experiments.runs.plans import Setup


@dataclasses.dataclass(frozen=True)
class Task:
    name: str = "Swimmer"
    obs_dim: int = 8
    action_dim: int = 2


FINAL_OBS = -np.arange(24, dtype=np.float32).reshape(3, 8)


def make(**changes: Any) -> Demonstrations:
    """Three episodes of 2, 3 and 1 steps."""
    fields: dict[str, Any] = {
        "obs": np.arange(48, dtype=np.float32).reshape(6, 8),
        "actions": np.linspace(-1, 1, 12, dtype=np.float32).reshape(6, 2),
        "rewards": np.array([1, 2, 3, 4, 5, 6], np.float32),
        "costs": np.array([0, 1, 1, 0, 1, 0], np.float32),
        "terminated": np.array([0, 1, 0, 0, 0, 0], bool),
        "truncated": np.array([0, 0, 0, 0, 1, 1], bool),
        "episode_ends": np.array([2, 5, 6]),
        "final_obs": FINAL_OBS,
        "metadata": {"task": "Swimmer", "method": "expert"},
    }
    return Demonstrations(**{**fields, **changes})


def arrays_of(demonstrations: Demonstrations) -> dict[str, Any]:
    """What a sound file holds, key by key."""
    arrays = {f.name: getattr(demonstrations, f.name) for f in dataclasses.fields(demonstrations)}
    return {**arrays, "metadata": np.array(json.dumps(demonstrations.metadata))}


def write(path: Path, remove: str | None = None, **changes: Any) -> Path:
    """A file with some keys changed or removed, written past our own checks."""
    arrays = {**arrays_of(make()), **changes}
    np.savez(path, allow_pickle=True, **{k: v for k, v in arrays.items() if k != remove})
    return path


def test_derived_numbers_are_sums_over_episodes() -> None:
    demonstrations = make()
    assert demonstrations.num_episodes == 3
    np.testing.assert_array_equal(demonstrations.episode_lengths, [2, 3, 1])
    np.testing.assert_array_equal(demonstrations.episode_returns, [3, 12, 6])
    np.testing.assert_array_equal(demonstrations.episode_costs, [1, 2, 0])
    assert demonstrations.mean_episode_cost == 1.0
    assert demonstrations.mean_episode_return == 7.0
    assert demonstrations.mean_episode_length == 2.0


def test_without_rewards_there_are_no_returns(tmp_path: Path) -> None:
    save_demonstrations(tmp_path / "d.npz", make(rewards=None))
    loaded = load_demonstrations(tmp_path / "d.npz")
    assert loaded.rewards is None
    assert loaded.episode_returns is None
    assert loaded.mean_episode_return is None
    assert loaded.take_episodes(1).rewards is None


def test_files_of_earlier_versions_lack_the_last_observations(tmp_path: Path) -> None:
    loaded = load_demonstrations(write(tmp_path / "d.npz", remove="final_obs"))
    assert loaded.final_obs is None
    assert loaded.take_episodes(1).final_obs is None


def test_take_episodes_keeps_the_first_whole_ones() -> None:
    taken = make().take_episodes(2)
    np.testing.assert_array_equal(taken.episode_ends, [2, 5])
    np.testing.assert_array_equal(taken.obs, make().obs[:5])
    np.testing.assert_array_equal(taken.episode_costs, [1, 2])
    np.testing.assert_array_equal(taken.final_obs, FINAL_OBS[:2])
    for count in (0, 4):
        with pytest.raises(DemonstrationsError, match="between 1 and 3"):
            make().take_episodes(count)


def test_file_round_trip_is_exact_and_reproducible(tmp_path: Path) -> None:
    saved = make()
    save_demonstrations(tmp_path / "a.npz", saved)
    save_demonstrations(tmp_path / "b.npz", load_demonstrations(tmp_path / "a.npz"))
    loaded = load_demonstrations(str(tmp_path / "b.npz"))
    for field in dataclasses.fields(saved):
        np.testing.assert_array_equal(getattr(loaded, field.name), getattr(saved, field.name))
    assert loaded.obs.dtype == loaded.actions.dtype == loaded.costs.dtype == np.float32
    assert loaded.metadata == saved.metadata
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]  # no temporary file is left


def test_other_layouts_of_sound_data_are_read(tmp_path: Path) -> None:
    text = np.frombuffer(json.dumps({"task": "Swimmer"}).encode(), np.uint8)
    obs = np.asfortranarray(make().obs.astype(np.float64))
    ends = np.array([2.0, 5.0, 6.0])
    path = write(tmp_path / "d.npz", obs=obs, costs=np.ones(6, np.int32), episode_ends=ends, metadata=text)
    loaded = load_demonstrations(path)
    np.testing.assert_array_equal(loaded.episode_ends, [2, 5, 6])
    assert loaded.episode_ends.dtype == np.int64
    np.testing.assert_array_equal(loaded.obs, make().obs)
    np.testing.assert_array_equal(loaded.costs, np.ones(6))
    assert loaded.metadata == {"task": "Swimmer"}


def test_numpy_reads_our_files_without_pickle(tmp_path: Path) -> None:
    save_demonstrations(tmp_path / "d.npz", make())
    with np.load(tmp_path / "d.npz", allow_pickle=False) as file:
        assert set(file) == {f.name for f in dataclasses.fields(Demonstrations)}
        assert json.loads(str(file["metadata"]))["task"] == "Swimmer"


def test_saving_refuses_what_loading_would_refuse(tmp_path: Path) -> None:
    for changes in ({"costs": -np.ones(6)}, {"metadata": {"x": object()}}, {"metadata": {"x": float("nan")}}):
        with pytest.raises(DemonstrationsError, match=r"d\.npz: '(costs|metadata)'"):
            save_demonstrations(tmp_path / "d.npz", make(**changes))
    with pytest.raises(DemonstrationsError, match=r"named \*\.npz"):
        save_demonstrations(tmp_path / "d.csv", make())


def nan_at(array: np.ndarray, row: int, value: float = np.nan) -> np.ndarray:
    array = array.copy()
    array[row] = value
    return array


BAD_ARRAYS: dict[str, tuple[dict[str, Any], str]] = {
    "missing key": ({"remove": "costs"}, "key 'costs' is missing"),
    "missing metadata": ({"remove": "metadata"}, "key 'metadata' is missing"),
    "rank": ({"obs": np.zeros((6, 2, 4))}, r"'obs' has shape \(6, 2, 4\), must have shape \(rows, columns\)"),
    "no axis": ({"costs": np.zeros(())}, r"'costs' has shape \(\), must have one axis"),
    "costs in a row": ({"costs": np.zeros((1, 6))}, r"'costs' has shape \(1, 6\), must have shape \(1,\)"),
    "vector of another length": ({"obs": np.zeros(48)}, "'actions' has 6 rows, 'obs' has 48"),
    "no columns": ({"actions": np.zeros((6, 0))}, "'actions' has no columns"),
    "text": ({"obs": np.full((6, 8), "x")}, "'obs' has dtype"),
    "complex": ({"costs": np.zeros(6, complex)}, "'costs' has dtype"),
    "flags as text": ({"terminated": np.full(6, "no")}, "'terminated' has dtype <U2, must be a number"),
    "flags beyond 1": (
        {"terminated": np.array([0, 1, 0, 0, 0, 2])},
        r"'terminated' holds 2 \(row 5\), must hold flags: true and false, or 1 and 0",
    ),
    "ends between rows": (
        {"episode_ends": np.array([2.0, 5.5, 6.0])},
        r"'episode_ends' holds 5\.5 \(entry 1\), must hold integers",
    ),
    "lengths": ({"actions": np.zeros((5, 2))}, "'actions' has 5 rows, 'obs' has 6"),
    "empty": (
        {
            "obs": np.zeros((0, 8)),
            "actions": np.zeros((0, 2)),
            "rewards": np.zeros(0),
            "costs": np.zeros(0),
            "terminated": np.zeros(0, bool),
            "truncated": np.zeros(0, bool),
            "episode_ends": np.zeros(0, int),
        },
        "'obs' is empty",
    ),
    "zero episodes": ({"episode_ends": np.zeros(0, int)}, "zero episodes"),
    "empty episode": ({"episode_ends": np.array([2, 2, 6])}, "does not increase at trajectory 1"),
    "decreasing": ({"episode_ends": np.array([5, 2, 6])}, "does not increase at trajectory 1"),
    "first empty": ({"episode_ends": np.array([0, 6])}, "does not increase at trajectory 0"),
    "short cover": ({"episode_ends": np.array([2, 5])}, "covers 5 of 6 rows"),
    "long cover": ({"episode_ends": np.array([2, 5, 7])}, "covers 7 of 6 rows"),
    "nan": ({"obs": nan_at(make().obs, 3)}, r"'obs' holds NaN or infinity.*trajectory 1, row 3"),
    "inf": ({"actions": nan_at(make().actions, 5, np.inf)}, r"'actions' holds NaN.*trajectory 2, row 5"),
    "too large for float32": ({"costs": np.full(6, 1e300)}, "'costs' holds NaN or infinity"),
    "nan reward": ({"rewards": np.full(6, np.nan)}, r"'rewards' holds NaN.*row 0"),
    "final observations": (
        {"final_obs": np.zeros((2, 8))},
        r"'final_obs' has shape \(2, 8\), must have shape \(3, 8\)",
    ),
    "nan at last": ({"final_obs": nan_at(FINAL_OBS, 1)}, r"'final_obs' holds NaN.*trajectory 1, row 1"),
    "negative cost": ({"costs": nan_at(make().costs, 2, -1)}, r"'costs' is negative.*trajectory 1, row 2"),
    "done inside": ({"terminated": np.ones(6, bool)}, r"'terminated' is true before.*trajectory 0, row 0"),
    "metadata not json": ({"metadata": np.array("{")}, "'metadata' is not a JSON object"),
    "metadata a list": ({"metadata": np.array("[1]")}, "'metadata' is not a JSON object"),
    "metadata bytes": ({"metadata": np.array([255, 254], np.uint8)}, "'metadata' is not a JSON object"),
    "metadata deep": ({"metadata": np.array("[" * 100_000)}, "'metadata' is not a JSON object"),
    "objects": ({"obs": np.full((6, 8), None)}, "'obs' holds pickled objects.*could execute code"),
    "object metadata": ({"metadata": np.array({"task": 1}, object)}, "'metadata' holds pickled objects"),
}


@pytest.mark.parametrize("case", BAD_ARRAYS)
def test_bad_arrays_end_in_one_line(tmp_path: Path, case: str) -> None:
    changes, message = BAD_ARRAYS[case]
    path = write(tmp_path / "bad.npz", **changes)
    with pytest.raises(DemonstrationsError, match=message) as error:
        load_demonstrations(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_files_of_another_task_or_size_are_refused() -> None:
    check_matches(make(), "d.npz", Task())
    check_matches(make(metadata={}), "d.npz", Task())  # converted files may not name their task
    with pytest.raises(DemonstrationsError, match=r"d\.npz: recorded on task 'Swimmer', not 'Ant'; use --env Swimmer"):
        check_matches(make(), "d.npz", Task(name="Ant"))
    with pytest.raises(DemonstrationsError, match=r"d\.npz: 'obs' has 8 columns, Swimmer has obs_dim 17"):
        check_matches(make(), "d.npz", Task(obs_dim=17))
    with pytest.raises(DemonstrationsError, match=r"d\.npz: 'actions' has 2 columns, Swimmer has action_dim 6"):
        check_matches(make(), "d.npz", Task(action_dim=6))


def test_trajectories_longer_than_an_episode_are_refused() -> None:
    check_time_limit(make(), "d.npz", 3)  # its trajectories have 2, 3 and 1 steps
    message = r"d\.npz: trajectory 1 has 3 steps, an episode of this run has at most 2; .* use --max-episode-steps 3 "
    with pytest.raises(DemonstrationsError, match=message):
        check_time_limit(make(), "d.npz", 2)


def test_training_refuses_trajectories_longer_than_its_episodes(tmp_path: Path) -> None:
    """Of any file, as only ours say under which time limit they were recorded; of those that are used."""
    save_demonstrations(tmp_path / "d.npz", make(metadata={}))
    parser = train.make_parser()

    def setup(*options: str) -> Setup:
        given = ["--method", "ccil", "--env", "Swimmer", "--demos", str(tmp_path / "d.npz"), *options]
        return train.make_plan(parser.parse_args([*given, "--out", str(tmp_path / "run")])).setup

    assert setup("--max-episode-steps", "3").demonstrations is not None
    assert setup("--max-episode-steps", "2", "--num-demos", "1").demonstrations is not None
    with pytest.raises(DemonstrationsError, match=r"d\.npz: trajectory 1 has 3 steps, .* at most 2; "):
        setup("--max-episode-steps", "2")


def test_a_missing_array_is_refused_when_saved(tmp_path: Path) -> None:
    with pytest.raises(DemonstrationsError, match=r"d\.npz: 'costs' has dtype object, must be a number"):
        save_demonstrations(tmp_path / "d.npz", make(costs=None))


def test_importing_the_package_imports_no_jax() -> None:
    code = "import ccil_jax, sys; ccil_jax.load_demonstrations, ccil_jax.Config; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_public_names_resolve() -> None:
    import ccil_jax

    assert all(getattr(ccil_jax, name) is not None for name in ccil_jax.__all__)
    assert set(ccil_jax.__all__) <= set(dir(ccil_jax))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        getattr(ccil_jax, "nothing")  # noqa: B009  (a misspelt name, as a type checker would not let it pass)
