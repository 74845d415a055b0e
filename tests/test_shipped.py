"""What comes with the package: demonstrations and the policies of their experts, whole and of the tasks they name."""

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest

from ccil_jax.demonstrations.trajectories import check_matches, load_demonstrations
from envs.registry import TASKS
from experiments.policies import policy_file
from tests.test_documentation import ROOT

FOLDER = Path(policy_file.__file__).parents[1]
DEMONSTRATIONS = sorted((FOLDER / "demonstrations").glob("*.npz"))
EXPERTS = sorted((FOLDER / "experts").glob("*.npz"))


def name_of(path: Path) -> str:
    return path.relative_to(FOLDER).as_posix()


def test_every_demonstrator_is_there_too() -> None:
    assert [path.name for path in DEMONSTRATIONS] == [path.name for path in EXPERTS]


def test_the_table_of_experts_has_the_shipped_ones_in_bold() -> None:
    """The README and other pages refer to it in the place of a list."""
    page = (ROOT / "docs" / "tasks.md").read_text(encoding="utf-8").partition("\n## Experts\n")[2]
    assert sorted(re.findall(r"^\| \*\*(\w+)\*\* ", page, re.MULTILINE)) == [path.stem for path in EXPERTS]


def test_every_file_has_the_checksum_of_the_list() -> None:
    """`sha256sum --check SHA256SUMS` in the folder says the same."""
    lines = (FOLDER / "SHA256SUMS").read_text(encoding="utf-8").splitlines()
    listed = {name: digest for digest, name in (line.split("  ") for line in lines)}
    found = {name_of(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in [*DEMONSTRATIONS, *EXPERTS]}
    assert found == listed
    assert list(listed) == sorted(listed)


@pytest.mark.parametrize("path", DEMONSTRATIONS, ids=name_of)
def test_demonstrations_are_of_their_task_and_say_where_they_are_from(path: Path) -> None:
    demonstrations = load_demonstrations(path)
    check_matches(demonstrations, path, TASKS[path.stem])
    facts = demonstrations.metadata
    assert facts["task"] == path.stem
    assert demonstrations.num_episodes == 10
    assert np.isfinite(demonstrations.obs).all()
    assert demonstrations.final_obs is not None
    assert "-dirty" not in facts["git_commit"]
    assert facts["evaluation"]["episode_cost"] <= facts["cost_limit"] <= (TASKS[path.stem].cost_limit or np.inf)


@pytest.mark.parametrize("path", EXPERTS, ids=name_of)
def test_an_expert_is_the_one_that_was_recorded(path: Path) -> None:
    """Its own episodes are those that the metadata of the demonstrations sum up: 100, with their standard errors."""
    file = policy_file.read(path)
    demonstrations = load_demonstrations(FOLDER / "demonstrations" / path.name)
    task, facts = TASKS[path.stem], demonstrations.metadata
    file.check_sizes(task.obs_dim, task.action_dim)
    assert file.num_policies == 1
    assert file.training["seed_indices"] == [facts["seed_index"]]
    assert all(facts[name] == value for name, value in file.training.items() if name != "seed_indices")
    with np.load(path) as arrays:
        for name in ("episode_return", "episode_cost"):
            values = arrays[name].astype(np.float64)
            assert values.shape == (1, 100)
            assert values.mean() == pytest.approx(facts["evaluation"][name], rel=1e-5)
            error = values.std(ddof=1) / 10
            assert error == pytest.approx(facts["evaluation"][f"{name}_standard_error"], rel=1e-4)
