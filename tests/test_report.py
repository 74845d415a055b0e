"""The page: self-contained, every seed on it, figures that decode; and the episode that it plays."""

import base64
import html.parser
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from ccil_jax.config import Config
from experiments import benchmark, figures, report, run_folder
from experiments.summary import Reference, aggregate_scores, scores


def make_run(folder: Path, method: str, task: str = "Swimmer", level: float = 50.0, **config: Any) -> Path:
    """A finished run of three seeds whose returns are level, level + 10 and level + 20."""
    folder.mkdir()
    facts = {
        "task": task,
        "physics": "native",
        "env_options": {},
        "preset": "paper",
        "command": f"train <{method}>",
        "seed": 0,
        "num_seeds": 3,
        "eval_episodes": 50,
        "device": {"kind": "cpu"},
        "demonstrations": None,
        "expert_return": 100.0,
        "expert_cost": 30.0,
        "expert_length": 1000.0,
    }
    run_folder.write_config(folder, Config(method=method, **config), facts)
    steps = np.arange(1, 6)[:, None] * np.ones((1, 3))
    rows = {
        "env_steps": 6000 * steps,
        "episode_return": 10 * steps + np.arange(3),
        "episode_cost": 5 * steps,
        "cost_rate": steps / 100,
        "episodes_finished": np.array([0, 2, 2, 2, 2])[:, None] * np.ones((1, 3)),
    }
    with run_folder.MetricsWriter(folder) as writer:
        writer.write(5, rows)
    reference = Reference(expert_return=100.0, expert_cost=30.0, random_return=0.0, random_cost=1.0, cost_limit=None)
    seeds = [
        {"seed": s, **scores(level + 10 * s, 33.0, reference), "cost_rate": 0.05, "episode_length": 1000.0}
        for s in range(3)
    ]
    content = {
        "task": task,
        "method": method,
        "num_seeds": 3,
        "per_seed": seeds,
        "aggregate": aggregate_scores(seeds),
        "expert_return": 100.0,
        "expert_cost": 30.0,
        "random_return": 0.0,
        "random_cost": 1.0,
        "env_steps": 30_000,
        "env_steps_per_second": 1234.5,
    }
    run_folder.write_json(folder / "summary.json", content)
    return folder


class Page(html.parser.HTMLParser):
    """Collects tags' balance, addresses and cell texts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.cells: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "html"):
            self.open.append(tag)
        if tag == "td":
            self.cells.append("")

    def handle_endtag(self, tag: str) -> None:
        if tag != "html":
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "td" in self.open:
            self.cells[-1] += data


def make_page(folders: Sequence[Path]) -> str:
    entries = report.read_entries(folders)
    return report.page(entries, report.draw_tasks(entries))


def test_page_is_self_contained_and_shows_every_seed(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / "a", "malm"), make_run(tmp_path / "b", "gail", level=70.0, max_kl=0.02)]
    text = make_page(folders)
    page = Page(text)
    assert page.open == []
    assert len(page.addresses) == 1
    assert page.addresses[0].startswith("data:image/png;base64,")
    image = matplotlib.image.imread(io.BytesIO(base64.b64decode(page.addresses[0].split(",")[1])))
    assert image.shape[0] > 300
    assert image.shape[1] > 1000
    assert not re.search(r"https?://", text)
    rows = " | ".join(page.cells)
    assert "60.00 [50.00, 70.00]" in rows  # interquartile mean of 50, 60, 70 and the range that resamples can reach
    for label in ("malm, seed 2 | 70.00 | 33.00 | 70.00 | 0.10 | 60.00", "gail, seed 2 | 90.00", "expert |  | 100.0"):
        assert label in rows
    assert "max_kl | 0.01 | 0.02" in rows
    assert "train &lt;malm&gt;" in text
    assert "Across tasks" not in text


def test_runs_of_several_tasks_are_also_pooled(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / "a", "malm"), make_run(tmp_path / "b", "malm", task="Ant", level=70.0)]
    page = Page(make_page(folders))
    rows = " | ".join(page.cells)
    assert "malm | 2 | 70.00 [" in rows  # interquartile mean of 50, 60, 70, 70, 80, 90
    assert len(page.addresses) == 2


def test_two_runs_of_one_method_are_told_apart(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / "a", "malm"), make_run(tmp_path / "b", "malm")]
    assert [e.label for e in report.read_entries(folders)] == ["malm (a)", "malm (b)"]
    assert "All fields are equal" in make_page(folders)


def test_report_writes_where_it_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_run(tmp_path / "a", "malm")
    assert report.main([str(folder), "--no-animation"]) == 0
    assert (folder / "report.html").read_text().startswith("<!DOCTYPE html>")
    assert report.main([str(folder), "--out", str(tmp_path / "x.html")]) == 0  # nothing to play without a checkpoint
    assert (tmp_path / "x.html").read_text() == (folder / "report.html").read_text()
    assert report.main([str(folder), "--no-animation", "--figures", str(tmp_path / "png")]) == 0
    assert matplotlib.image.imread(tmp_path / "png" / "Swimmer.png").shape[1] > 1000
    (folder / "summary.json").unlink()
    with pytest.raises(SystemExit) as end:
        report.main([str(folder)])
    assert end.value.code == 2
    assert "not finished" in capsys.readouterr().err


def test_long_curves_are_drawn_as_means_over_iterations() -> None:
    np.testing.assert_allclose(figures.binned(np.array([1.0, 3.0, 5.0, 7.0, 4.0]), 2), [2.0, 6.0, 4.0])
    by_seed = figures.binned(np.array([[np.nan, 1.0], [2.0, 3.0]]), 2)
    np.testing.assert_array_equal(by_seed, [[np.nan, 2.0]])


def test_curves_start_with_the_first_finished_episode(tmp_path: Path) -> None:
    figure = figures.draw_panels([figures.read_curve(make_run(tmp_path / "a", "malm"))], "Swimmer")
    mean = {axes.get_title(loc="left"): np.asarray(axes.lines[-2].get_ydata()) for axes in figure.axes}
    np.testing.assert_allclose(mean["Return"], [np.nan, 21, 31, 41, 51])
    np.testing.assert_allclose(mean["Cost rate"], [0.01, 0.02, 0.03, 0.04, 0.05])
    levels = {axes.get_title(loc="left"): axes.lines[-1].get_ydata()[0] for axes in figure.axes}  # type: ignore[index]
    assert levels == {"Return": 100.0, "Cost per episode": 30.0, "Cost rate": 0.03}


def test_poses_are_drawn_from_the_engine() -> None:
    import envs
    from experiments.animation import record_poses, to_html

    class Still:
        """A policy that does nothing."""

        def sample(self, obs: np.ndarray, random: np.random.Generator) -> np.ndarray:
            return np.zeros(6)

    env: Any = envs.make("HalfCheetah", physics="native")
    poses = record_poses(env, Still(), num_steps=20)  # type: ignore[arg-type]
    assert poses.frames.shape == (10, 8, 4)
    assert poses.seconds_per_frame == pytest.approx(0.1)
    lengths = np.hypot(*(poses.frames[:, :, 2:] - poses.frames[:, :, :2]).transpose(2, 0, 1))
    np.testing.assert_allclose(lengths, np.tile(lengths[0], (10, 1)), atol=1e-6)  # bones do not stretch
    np.testing.assert_allclose(lengths[0, 0], 1.0, atol=1e-6)  # the torso's capsule, 2 x 0.5 m
    assert -0.2 < poses.frames[:, :, [1, 3]].min() < 0.3  # it lies on the floor
    text = to_html(poses, "episode", "a <cheetah>.")
    assert "a &lt;cheetah&gt;." in text
    assert text.count("<canvas") == 1


def test_benchmark_settings_and_table(capsys: pytest.CaptureFixture[str]) -> None:
    parser = benchmark.make_parser()
    arguments = parser.parse_args(["--tasks", "Swimmer", "Ant", "--num_seeds", "1", "2", "--quick"])
    settings = benchmark.settings_of(arguments)
    assert [(s["task"], s["num_seeds"]) for s in settings] == [("Swimmer", 1), ("Swimmer", 2), ("Ant", 1), ("Ant", 2)]
    row = {
        "task": "Swimmer",
        "physics": "native",
        "num_seeds": 8,
        "num_envs": 16,
        "compile_seconds": 12.0,
        **{f"{name}_steps_per_second": 1e4 for name in ("physics", "rollout", "training")},
        "training_to_physics": 0.5,
        "training_to_rollout": 0.75,
        "meta_gradient_to_policy_step": 0.1,
        "peak_memory": 900.0,
    }
    benchmark.print_rows([row])
    out = capsys.readouterr().out
    for text in ("Swimmer (native)", "8 x 16", "10,000", "0.50", "0.75", "0.10", "12.0", "900"):
        assert text in out


def test_benchmark_measures_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")  # its speed does not matter here
    tiny = ["--tasks", "Swimmer", "--num-seeds", "2", "--num-envs", "4", "--preset", "tiny", "--quick"]
    assert benchmark.main([*tiny, "--out", str(tmp_path / "b.json")]) == 0
    (row,) = run_folder.read_json(tmp_path / "b.json")["rows"]
    assert (row["task"], row["num_seeds"], row["num_envs"]) == ("Swimmer", 2, 4)
    assert min(row[f"{name}_steps_per_second"] for name in ("physics", "rollout", "training")) > 0
    ratio = row["training_steps_per_second"] / row["physics_steps_per_second"]
    assert row["training_to_physics"] == pytest.approx(ratio)
    assert row["compile_seconds"] > 0
    assert row["peak_memory"] > 100


def test_a_safety_gym_episode_is_drawn_from_above() -> None:
    import envs
    from experiments import top_down

    class Ahead:
        """Full thrust."""

        def sample(self, obs: np.ndarray, random: np.random.Generator) -> np.ndarray:
            return np.array([1.0, 0.2])

    env: Any = envs.make("PointGoal1", physics="native")
    episode = top_down.record(env, Ahead(), num_steps=30)  # type: ignore[arg-type]
    assert episode.robot.shape == (31, 2)
    assert {name: places.shape for name, places in episode.objects.items()} == {
        "goal": (31, 1, 2),
        "hazards": (31, 8, 2),
        "vases": (31, 1, 2),
    }
    assert np.hypot(*np.diff(episode.robot, axis=0).T).max() > 1e-3
    axes = top_down.draw(env, episode).axes[0]
    circles = [patch for patch in axes.patches if patch.get_gid() is None and hasattr(patch, "radius")]
    assert len(circles) == 8 + 1 + episode.met.sum()
    assert "PointGoal1: 30 steps" in axes.get_title(loc="left")
