"""The pages: their links lead somewhere, and the README stays what is read in two minutes."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

from ccil_jax.agents import build
from ccil_jax.agents.expert import expert_data
from envs.locomotion import load_model
from envs.locomotion_tasks import TABLE
from envs.registry import TASKS
from tests.probe_envs import Walk, walk_config, walk_demonstrations

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for pattern in ("*.md", "docs/*.md", "experiments/*/README.md")
    for path in ROOT.glob(pattern)
)
LINK = re.compile(r"\]\(([^)\s]+)\)")


def anchors(path: Path) -> set[str]:
    """What a link can name after `#`: the headings, in the form that GitHub and mkdocs give them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    for target in LINK.findall((ROOT / page).read_text(encoding="utf-8")):
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        path = (ROOT / page).parent / name if name else ROOT / page
        assert path.exists(), target
        assert not anchor or anchor in anchors(path), target


def test_the_readme_is_short_and_leads_to_every_page() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert len(text.split()) <= 1200
    linked = set(LINK.findall(text))
    pages = {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")} - {
        "docs/index.md",
        "docs/ablations_paper.md",
    }
    assert pages <= {target.partition("#")[0] for target in linked}


def test_the_table_of_tasks_is_that_of_the_registry() -> None:
    rows = re.findall(
        r"^\| (\w+) \| (\d+): [^|]+ \| (\d+) \| [^|]+ \| [^|]+ \| (\d+) \|$",
        (ROOT / "docs" / "tasks.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    found = [(name, *map(int, numbers)) for name, *numbers in rows]
    built_in = [task for task in TASKS.values() if task.original_package]  # other tests register tasks of their own
    assert found == [(task.name, task.obs_dim, task.action_dim, task.cost_limit) for task in built_in]


def test_the_table_of_observations_is_that_of_the_models() -> None:
    """Where velocities begin and end, and that the numbers of a row name every place once."""
    text = (ROOT / "docs" / "tasks.md").read_text(encoding="utf-8").partition("## Locomotion")[2]
    rows = re.findall(r"^\| (\w+) \| (\d[^|]+) \| (\d[^|]+) \|$", text, re.MULTILINE)
    assert [name for name, *_ in rows] == list(TABLE)
    for name, *columns in rows:
        model, row = load_model(TABLE[name].xml), TABLE[name]
        first = model.nq - row.num_hidden
        for column, places in zip(columns, (range(first), range(first, first + model.nv)), strict=True):
            named = re.findall(r"(?:^|, )(\d+)(?:-(\d+))? [a-z]", column)
            assert [i for low, high in named for i in range(int(low), int(high or low) + 1)] == list(places)


def test_every_task_has_a_picture_on_the_page() -> None:
    text = (ROOT / "docs" / "tasks.md").read_text(encoding="utf-8")
    built_in = [task.name for task in TASKS.values() if task.original_package]
    assert sorted(re.findall(r"!\[(\w+)\]\(figures/tasks/\1\.png\)", text)) == sorted(built_in)
    assert sum(path.stat().st_size for path in (ROOT / "docs" / "figures" / "tasks").iterdir()) < 400_000


def test_every_shipped_expert_has_a_picture_on_the_page() -> None:
    text = (ROOT / "docs" / "experts.md").read_text(encoding="utf-8")
    shipped = [path.stem for path in (ROOT / "experiments" / "experts").glob("*.npz")]
    assert sorted(re.findall(r"!\[(\w+)\]\(figures/experts/\1\.png\)", text)) == sorted(shipped)
    assert sum(path.stat().st_size for path in (ROOT / "docs" / "figures" / "experts").iterdir()) < 400_000


def script(path: str) -> Any:
    """A script of the documentation, as a module."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / "docs" / path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pictures_are_of_the_tasks_as_they_are() -> None:
    """Drawn anew, one is the same but for the colours that a small file has."""
    make_tasks = script("figures/make_tasks.py")
    with Image.open(make_tasks.FOLDER / "HalfCheetah.png") as shipped:
        kept = np.asarray(shipped.convert("RGB"), float)
    drawn = np.asarray(make_tasks.draw("HalfCheetah"), float)
    assert np.abs(drawn - kept).mean() < 1.0
    assert np.abs(drawn - drawn[0, 0]).mean() > 10.0  # it is not all sky


def test_the_table_of_results_has_the_numbers_of_the_runs() -> None:
    make_table = script("results/make_table.py")
    entries = json.loads(make_table.NUMBERS.read_text(encoding="utf-8"))
    page = make_table.PAGE.read_text(encoding="utf-8")
    assert make_table.with_table(page, entries) == page
    assert make_table.updated(entries, []) == entries


def test_a_row_of_the_table_of_results_by_hand(tmp_path: Path) -> None:
    """Two seeds with 110 and 80 of 110 to be recovered from 10, and standard errors of 3 and 4: 5 / 2 is 2.5 %."""
    make_table = script("results/make_table.py")
    seeds = [
        {
            "recovered_return": recovered,
            "episode_return": episode_return,
            "episode_return_standard_error": error,
            "episode_cost": cost,
            "episode_cost_standard_error": 0.1,
        }
        for recovered, episode_return, error, cost in ((100.0, 110.0, 3.0, 20.0), (70.0, 80.0, 4.0, 31.0))
    ]
    started = {
        "demonstrations": {"num_episodes": 10},
        "seed": 1000,
        "eval_episodes": 50,
        "git_commit": "abc",
        "versions": {"python": "3.11", "jax": "1", "mujoco": "3", "flax": "1"},
    }
    ended = {
        "task": "Hopper",
        "method": "malm",
        "env_steps": 300_000,
        "expert_return": 110.0,
        "expert_cost": 25.0,
        "expert_cost_standard_error": 1.25,
        "random_return": 10.0,
        "wall_seconds": 12.3,
        "evaluation": {"deterministic": True},
        "per_seed": seeds,
    }
    for name, content in (("config.json", started), ("summary.json", ended)):
        (tmp_path / name).write_text(json.dumps(content), encoding="utf-8")
    entry = make_table.entry_of(tmp_path)
    row = "| Hopper, 10 | malm | 300,000 | 100.0, 70.0 | 85.0 +- 2.5 | 20.0, 31.0 | 25.5 +- 0.07 |"
    assert make_table.row(entry, is_first=True) == f"{row} 25.0 +- 1.2 |"
    assert make_table.row(entry, is_first=False) == f"{row} |"
    newer, longer = {**entry, "seed": 7}, {**entry, "env_steps": 1_000_000}
    assert make_table.updated([longer, entry], [newer]) == [newer, longer]


def test_every_metric_is_explained() -> None:
    """The table has the columns that the methods report and no others."""
    text = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8").partition("Every column")[2]
    listed = {name for row in re.findall(r"^\| (`.*?) \| ", text, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
    reported = {"iteration", "seed", "env_steps", "skipped_updates"}
    for method in ("malm", "bc", "iq_learn"):
        changes = {"cloning_updates": 100} if method == "bc" else {}
        config = build.resolve(walk_config(method=method, **changes), Walk(), walk_demonstrations())
        agent = build.make(config, Walk(), expert_data(walk_demonstrations()))
        state = jax.eval_shape(agent.init, jax.random.key(0))
        reported |= jax.eval_shape(agent.step, state)[1].keys()
    assert listed == reported


def test_nothing_is_misspelt() -> None:
    """Pages, docstrings, comments and messages. Tests are left out: some have wrong names on purpose."""
    sources = [*PAGES, "Makefile", "pyproject.toml", "ccil_jax", "envs", "experiments"]
    command = [sys.executable, "-m", "codespell_lib", "--skip=*.npz,*.json,*.csv,*.png,*.xml,*.pyc", *sources]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """Strictly: every page is in the navigation, every link and anchor exists, every name of the API is documented."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    mathematics = (tmp_path / "mathematics" / "index.html").read_text(encoding="utf-8")
    assert mathematics.count("<math") == (ROOT / "docs" / "mathematics.md").read_text(encoding="utf-8").count("```math")
    api = (tmp_path / "api" / "index.html").read_text(encoding="utf-8")
    import ccil_jax
    import envs

    for package in (ccil_jax, envs):
        for name in set(package.__all__) - {"__version__", "PHYSICS"}:
            assert f'id="{package.__name__}.{name}"' in api, name
