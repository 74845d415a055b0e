"""The page: self-contained, every seed on it, figures that decode."""

import base64
import errno
import html.parser
import io
import re
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from matplotlib.patches import Rectangle

from ccil_jax.config import Config
from ccil_jax.training.progress import Display
from experiments import benchmark, report
from experiments.cli.command_line import UsageError
from experiments.page import document, plots
from experiments.page.entries import choose_seed, read_entries
from experiments.runs import execution, figures, labels, run_folder, summary
from experiments.runs.metrics_file import MetricsWriter, read_metrics
from experiments.runs.summary import Reference, aggregate_scores, scores
from experiments.speed import tables

ERRORS = {"expert_return_standard_error": 2.0, "expert_cost_standard_error": 1.5}


def make_run(
    folder: Path,
    method: str,
    task: str = "Swimmer",
    level: float = 50.0,
    num_seeds: int = 3,
    errors: dict[str, float] = ERRORS,
    **config: Any,
) -> Path:
    """A finished run whose seeds return level, level + 10 and so on; without `errors` as earlier versions wrote it."""
    folder.mkdir(parents=True)
    facts = {
        "task": task,
        "physics": "native",
        "env_options": {},
        "preset": "paper",
        "command": f"train <{method}>",
        "seed": 0,
        "num_seeds": num_seeds,
        "eval_episodes": 50,
        "device": {"kind": "cpu"},
        "demonstrations": None,
        "expert_return": 100.0,
        "expert_cost": 30.0,
        "expert_length": 1000.0,
        **errors,
    }
    run_folder.write_config(folder, Config(method=method, **{"env_steps": 30_000, **config}), facts)
    steps = np.arange(1, 6)[:, None] * np.ones((1, num_seeds))
    rows = {
        "env_steps": 6000 * steps,
        "episode_return": 10 * steps + np.arange(num_seeds),
        "episode_cost": 5 * steps,
        "cost_rate": steps / 100,
        "episodes_finished": np.array([0, 2, 2, 2, 2])[:, None] * np.ones((1, num_seeds)),
    }
    if method == "bc":
        rows = {"env_steps": 0 * steps, "loss": 1 / steps, "held_out_loss": 2 / steps}
    with MetricsWriter(folder) as writer:
        writer.write(5, rows)
    levels: dict[str, Any] = {"expert_return": 100.0, "expert_cost": 30.0, "random_return": 0.0, "random_cost": 1.0}
    reference = Reference(**levels, cost_limit=None, **errors)
    seeds: list[dict[str, Any]] = [
        {"seed": s, **scores(level + 10 * s, 33.0, reference), "cost_rate": 0.05, "episode_length": 1000.0}
        for s in range(num_seeds)
    ]
    if errors:
        for row in seeds:
            row |= {"episode_return_standard_error": 0.5, "episode_cost_standard_error": 0.25}
        levels |= {"violation_beyond_error": summary.mean_violation_beyond_error(seeds, reference), **errors}
    content = {
        "task": task,
        "method": method,
        "num_seeds": num_seeds,
        "per_seed": seeds,
        "aggregate": aggregate_scores(seeds),
        **levels,
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
    return document.page(read_entries(folders))


def test_page_is_self_contained_and_shows_every_seed(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / "a", "malm"), make_run(tmp_path / "b", "gail", level=70.0, max_kl=0.02)]
    text = make_page(folders)
    page = Page(text)
    assert page.open == []
    assert len(page.addresses) == 4  # return, cost, cost rate, and return against cost
    for address in page.addresses:
        assert address.startswith("data:image/png;base64,")
        image = matplotlib.image.imread(io.BytesIO(base64.b64decode(address.split(",")[1])))
        assert image.shape[0] > 300
        assert image.shape[1] > 600
    assert not re.search(r"https?://", text)
    rows = " | ".join(page.cells)
    assert "60.00 [50.00, 70.00]" in rows  # interquartile mean of 50, 60, 70 and the range that resamples can reach
    assert "malm, seed 2 | 70.00 ± 0.50 | 33.00 ± 0.25 | 70.00 | 0.10 * | 60.00" in rows
    assert "gail, seed 2 | 90.00 ±" in rows
    assert "expert | 100.0 ± 2.00 | 30.00 ± 1.50 |" in rows
    assert "random policy | 0.00 ± - | 1.00 ± - |" in rows
    assert text.count("title='beyond the demonstrations&#x27; error'") == 2 + 6  # runs and seeds
    assert "docs/metrics.md" in text
    assert "max_kl | 0.01 | 0.02" in rows
    assert "train &lt;malm&gt;" in text
    assert "Across tasks" not in text


def test_runs_of_several_tasks_are_also_pooled(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / "a", "malm"), make_run(tmp_path / "b", "malm", task="Ant", level=70.0)]
    page = Page(make_page(folders))
    rows = " | ".join(page.cells)
    assert "malm | 2 | 70.00 [" in rows  # interquartile mean of 50, 60, 70, 70, 80, 90
    assert len(page.addresses) == 8


def test_a_page_of_an_earlier_versions_run_shows_dashes_for_what_it_lacks(tmp_path: Path) -> None:
    text = make_page([make_run(tmp_path / "a", "malm", num_seeds=2, errors={})])
    rows = " | ".join(Page(text).cells)
    assert "malm | 55.00 [-] | 33.00 [-] | 55.00 [-] | 0.10 [-] | 45.00 [-] | 0.05 [-] | 2 | 30,000" in rows
    assert "malm, seed 1 | 60.00 ± - | 33.00 ± - | 60.00 | 0.10 | 50.00" in rows
    assert "expert | 100.0 ± - | 30.00 ± - |" in rows
    assert "class=beyond" not in text


def test_levels_that_differ_between_runs_have_rows_of_their_own(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / "a", "malm"), make_run(tmp_path / "b", "lgail", errors={})]
    content = run_folder.read_json(folders[1] / "summary.json")
    run_folder.write_json(folders[1] / "summary.json", content | {"cost_limit": 25.0, "random_cost": 2.0})
    rows = " | ".join(Page(make_page(folders)).cells)
    assert "random policy of malm | 0.00 ± - | 1.00 ± - |" in rows
    assert "random policy of lgail | 0.00 ± - | 2.00 ± - |" in rows
    assert "cost limit of lgail |  | 25.00 |" in rows
    assert "cost limit of malm" not in rows


def test_two_runs_of_one_method_are_told_apart(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / "a", "malm"), make_run(tmp_path / "b", "malm")]
    assert [e.label for e in read_entries(folders)] == ["malm (a)", "malm (b)"]
    assert "All fields are equal" in make_page(folders)


def test_folders_of_one_name_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [make_run(tmp_path / name, "malm") for name in ("a/x/run", "b/x/run", "c/run", "d")]
    monkeypatch.chdir(folders[0])
    entries = read_entries([Path(), *folders[1:]])
    assert [e.label for e in entries] == [f"malm ({name})" for name in ("a/x/run", "b/x/run", "c/run", "d")]
    with pytest.raises(UsageError, match=r"RUN_DIR .*run: the same folder twice; give each run once"):
        read_entries([Path(), folders[0]])
    assert labels.distinct_names([Path("/run"), Path("/a/run")]) == ["/run", "a/run"]


@pytest.mark.parametrize("name", ["$_{x$", "cost$5$", "a\\$b", "_hidden", "[red]x", "<i>", "tab\t"])
def test_names_are_drawn_as_they_are(name: str, tmp_path: Path) -> None:
    """As a run's label, in the legend, and as a task, in the title; and on the page."""
    folders = [make_run(tmp_path / name, "malm", task=name), make_run(tmp_path / "b", "malm", task=name)]
    entries = read_entries(folders)
    curves = [figures.Curve(name, read_metrics(folders[0]), {}, None)]
    figure = figures.draw_panels(curves, name, ["cost_rate"])
    assert figures.png(figure).startswith(b"\x89PNG")
    shown = [figure.legends[0].get_texts()[0], figure._suptitle]
    for text, expected in zip(shown, (name, f"{name}: mean and standard deviation over 3 seeds"), strict=True):
        drawn, is_mathematics = text._preprocess_math(text.get_text())
        assert not is_mathematics
        assert drawn == expected.replace("\t", "?")
    assert f"malm ({name}), seed 0" in " | ".join(Page(document.page(entries)).cells)


def test_report_writes_where_it_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_run(tmp_path / "a", "malm")
    assert report.main([str(folder), "--no-animation"]) == 0
    assert (folder / "report.html").read_text().startswith("<!DOCTYPE html>")
    assert report.main([str(folder), "--out", str(tmp_path / "x.html")]) == 0
    sentence = "<p class=note>No episode of malm is shown: its folder holds no checkpoint.</p>\n"
    assert (tmp_path / "x.html").read_text().replace(sentence, "") == (folder / "report.html").read_text()
    assert sentence in (tmp_path / "x.html").read_text()
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
    spans = [[patch for patch in axes.patches if isinstance(patch, Rectangle)] for axes in figure.axes]
    bounds = [[(patch.get_y(), patch.get_y() + patch.get_height()) for patch in patches] for patches in spans]
    assert bounds == [[(98.0, 102.0)], [(28.5, 31.5)], []]  # the standard errors; that of the rate is not known
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        *("malm", "mean of the demonstrations", "its standard error")
    ]


def test_curves_of_single_seeds_and_of_none_that_is_known() -> None:
    """One seed has no deviation, and a run in which no episode has ended no curve."""
    nan = np.nan
    values = np.array([[nan, nan], [nan, 4.0], [2.0, 6.0]])
    metrics = {"env_steps": np.array([[10, 10], [20, 20], [30, 30]]), "episode_return": values}
    figure = figures.draw_panels([figures.Curve("malm", metrics, {}, None)], "Swimmer")
    np.testing.assert_array_equal(figure.axes[0].lines[-1].get_ydata(), [nan, 4.0, 4.0])  # of the seeds that have one
    metrics = {"env_steps": metrics["env_steps"][:, :1], "episode_return": np.full((3, 1), nan)}
    figure = figures.draw_panels([figures.Curve("malm", metrics, {}, None)], "Swimmer")
    assert np.isnan(np.asarray(figure.axes[0].lines[-1].get_ydata())).all()
    assert figure.get_suptitle() == "Swimmer: one seed"
    assert figures.png(figure).startswith(b"\x89PNG")


def test_return_is_drawn_against_cost(tmp_path: Path) -> None:
    """Means over seeds and, with its standard errors, the expert; the line is the cost that is allowed."""
    entries = read_entries([make_run(tmp_path / "a", "malm"), make_run(tmp_path / "b", "gail", level=70.0)])
    axes = plots.draw_return_against_cost([plots.of_run(e) for e in entries], "x").axes[0]
    drawn = []
    for bars in axes.containers:
        (cost,), (level,) = bars.lines[0].get_data()
        lengths = [float(np.ptp(line.get_segments()[0], axis=0).max()) / 2 for line in bars.lines[2]]
        drawn.append((cost, level, *lengths))
    mean = float(np.sqrt(3)) / 3
    expected = [(33.0, 60.0, 0.25 * mean, 0.5 * mean), (33.0, 80.0, 0.25 * mean, 0.5 * mean), (30.0, 100.0, 1.5, 2.0)]
    np.testing.assert_allclose(drawn, expected, rtol=1e-6)
    assert list(axes.lines[-1].get_xdata()) == [30.0, 30.0]
    seeds = [np.asarray(line.get_ydata()).tolist() for line in axes.lines if len(line.get_xdata()) == 3]
    assert seeds == [[50.0, 60.0, 70.0], [70.0, 80.0, 90.0]]


def test_what_goes_on_inside_a_method_is_drawn_where_there_is_something(tmp_path: Path) -> None:
    nan, ones = np.full((3, 2), np.nan), np.ones((3, 2))
    metrics = {"env_steps": ones, "episode_return": ones, "multiplier": 0 * ones, "meta_gradient": nan}
    curves = [
        figures.Curve("gail", {**metrics, "discriminator_accuracy_held_out": ones}, {}, None),
        figures.Curve("malm", {**metrics, "multiplier": ones}, {}, None),
    ]
    panels = [(panel.metric, list(panel.curves)) for panel in figures.inner_panels_of(curves)]
    assert panels == [("multiplier", [1]), ("discriminator_accuracy_held_out", [0])]
    folder = make_run(tmp_path / "a", "malm")
    assert "Inside the methods" not in make_page([folder])
    metrics = {name: np.vstack([rows, rows]) for name, rows in read_metrics(folder).items()}
    with MetricsWriter(folder) as writer:
        writer.begin({**metrics, "multiplier": metrics["env_steps"]})
    page = Page(make_page([folder]))
    assert len(page.addresses) == 5


def test_cloning_is_drawn_against_its_iterations_beside_runs_that_take_steps(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / "a", "gail"), make_run(tmp_path / "b", "bc")]
    figure = figures.draw_panels([figures.read_curve(folder) for folder in folders], "Swimmer")
    drawn = {axes.get_title(loc="left"): axes for axes in figure.axes}
    assert {title: axes.get_xlabel() for title, axes in drawn.items()} == {
        **dict.fromkeys(("Return", "Cost per episode", "Cost rate"), "iterations of 6,000 steps"),
        **dict.fromkeys(("Loss, nats", "Loss on held-out steps, nats"), "iterations of 100 gradient steps"),
    }
    np.testing.assert_array_equal(drawn["Loss, nats"].lines[-1].get_xdata(), [1, 2, 3, 4, 5])
    assert drawn["Loss, nats"].lines[-1].get_color() == figures.COLORS[1]
    both = [{"env_steps": steps * np.ones((4, 1)), "loss": np.ones((4, 1))} for steps in (0, 7)]
    panels = figures.panels_of([figures.Curve("x", metrics, {}, None) for metrics in both])  # one metric of both kinds
    assert [(panel.metric, panel.cloning, list(panel.curves)) for panel in panels] == [
        ("loss", False, [1]),
        ("loss", True, [0]),
    ]


def test_the_episode_shown_is_said_to_be_of_the_best_seed(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / "a/run", "malm"), make_run(tmp_path / "b/run", "malm", num_seeds=1)]
    content = run_folder.read_json(folders[0] / "summary.json")
    content["per_seed"][2]["episode_return"] = None  # was not finite
    run_folder.write_json(folders[0] / "summary.json", content)
    assert [choose_seed(entry) for entry in read_entries(folders)] == [
        (1, "One episode of malm (a/run), seed 1, which has the highest mean return of 3 seeds."),
        (0, "One episode of malm (b/run), seed 0."),
    ]


def progress(**metrics: list[float]) -> Any:
    """Two seeds' latest row."""
    return types.SimpleNamespace(
        iteration=2,
        num_iterations=2,
        compile_seconds=1.0,
        env_steps_per_second=1000.0,
        metrics={name: np.array([values]) for name, values in metrics.items()},
    )


@pytest.mark.parametrize("has_multiplier", [True, False])
def test_progress_says_nothing_of_what_is_unknown(has_multiplier: bool, capsys: pytest.CaptureFixture[str]) -> None:
    nan = np.nan
    display = Display("[red]gail[/red] :smile:", 2, 25.0, has_multiplier=has_multiplier)
    display.update(progress(episode_return=[nan, nan], episode_cost=[nan, 4.0], multiplier=[0.0, 0.0]))
    line = capsys.readouterr().err.splitlines()[-1]
    multiplier = "lambda 0.00  " if has_multiplier else ""
    assert line == f"[red]gail[/red] :smile: 2/2  return -  cost 4.00 / 25.00  {multiplier}1,000 steps/s"


class Episodes(types.SimpleNamespace):
    """Stands in for an evaluation."""


def test_the_summary_is_the_last_file_of_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its presence says that the run is complete."""
    folder = make_run(tmp_path / "a", "gail", num_seeds=2)
    (folder / "summary.json").unlink()
    plan: Any = types.SimpleNamespace(
        folder=folder,
        config=Config(method="gail"),
        setup=types.SimpleNamespace(task="Swimmer", num_seeds=2, eval_episodes=2, demonstrations=None),
    )
    result: Any = types.SimpleNamespace(env_steps=30_000, wall_seconds=1.0, compile_seconds=1.0)
    values = np.array([[1.0, 3.0], [5.0, 9.0]])
    evaluated: Any = Episodes(episode_return=values, episode_cost=values, episode_length=values)
    random: Any = Episodes(episode_return=values[:1], episode_cost=values[:1], episode_length=values[:1])

    def no_space(path: Path) -> Path:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(figures, "draw_run", no_space)
        with pytest.raises(OSError, match="No space left"):
            execution._finish(plan, result, None, 2, evaluated, random)
    assert not (folder / "summary.json").exists()
    execution._finish(plan, result, None, 2, evaluated, random)
    content = run_folder.read_json(folder / "summary.json")
    assert content["expert_cost_standard_error"] is content["violation_beyond_error"] is None
    assert (content["random_return_standard_error"], content["random_cost_standard_error"]) == (1.0, 1.0)
    assert [row["episode_cost_standard_error"] for row in content["per_seed"]] == [1.0, 2.0]
    assert content["aggregate"]["episode_cost"]["low"] is None


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
    tables.print_rows([row])
    out = capsys.readouterr().out
    for text in ("Swimmer (native)", "8 x 16", "10,000", "0.50", "0.75", "0.10", "12.0", "900"):
        assert text in out


@pytest.mark.once
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


def error_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line of a report that is refused."""
    with pytest.raises(SystemExit) as end:
        report.main([*arguments, "--no-animation"])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_a_report_replaces_nothing_but_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, figure = make_run(tmp_path / "run", "gail"), tmp_path / "figures" / "Swimmer.png"
    before = (folder / "config.json").read_bytes()
    assert "config.json: exists; choose another name" in error_of(capsys, str(folder), "--out", f"{folder}/config.json")
    assert (folder / "config.json").read_bytes() == before
    assert "--out" in error_of(capsys, str(folder), "--out", str(folder))  # a folder
    for _ in range(2):  # a page of its own is brought up to date
        assert report.main([str(folder), "--no-animation"]) == 0
    assert report.main([str(folder), "--no-animation", "--figures", str(figure.parent)]) == 0
    assert "Swimmer.png: exists" in error_of(capsys, str(folder), "--figures", str(figure.parent))
    assert report.main([str(folder), "--no-animation", "--figures", str(figure.parent), "--overwrite"]) == 0


def test_a_run_that_goes_on_is_not_reported_as_finished(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_run(tmp_path / "run", "gail")
    metrics = {name: rows[-1:] for name, rows in read_metrics(folder).items()}
    with MetricsWriter(folder) as writer:
        writer.begin({})
        writer.write(6, {**metrics, "env_steps": metrics["env_steps"] + 6000})
    run = run_folder.read_run(folder)
    run_folder.write_config(folder, run.config.replace(env_steps=36_000), run.facts)
    assert "continued and not finished; finish it with `train --resume`" in error_of(capsys, str(folder))
    run_folder.write_json(folder / "summary.json", {"num_seeds": 3})
    assert "summary.json: 'env_steps' is missing; the run folder is damaged" in error_of(capsys, str(folder))


def test_settings_that_a_run_does_not_use_are_shown_as_a_dash(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / method, method) for method in ("bc", "gail")]
    entries = read_entries(runs)
    page = document.page(entries)
    assert "<tr><td>actor_learning_rate</td><td>0.001</td><td>-</td></tr>" in page
    assert "<tr><td>env_steps</td><td>-</td><td>30000</td></tr>" in page
    assert "<td>gate</td>" not in page
