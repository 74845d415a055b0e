"""What a training leaves in the folders of its runs while it goes on: config.json, metrics.csv, and its speed."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ccil_jax.config import Config
from ccil_jax.training.filesystem import content_sha256
from experiments.cli import options
from experiments.runs import run_folder, summary
from experiments.runs.metrics_file import MetricsWriter
from experiments.runs.plans import RunPlan
from experiments.runs.wandb_log import WandbWriter

if TYPE_CHECKING:
    from ccil_jax.training.loop import History, Progress


class RunLog:
    """Writes what the training reports into the folders of its runs, and measures its speed.

    Args:
        config: the static fields of all runs.
        runs: each run that is to be recorded, with its columns in the reported metrics [iterations, num_runs].
        env: the task that the runs are trained on.
        stack: closes the files.
    """

    def __init__(
        self, config: Config, runs: Sequence[tuple[RunPlan, slice]], env: Any, stack: contextlib.ExitStack
    ) -> None:
        self._steps_per_iteration = config.steps_per_iteration
        self._plans, self._env = [plan for plan, _ in runs], env
        self._writers = [(writer, columns) for plan, columns in runs for writer in _writers_of(plan)]
        for writer, _ in self._writers:
            stack.enter_context(writer)
        self._steps = self._seconds = 0.0

    def begin(self, history: "History") -> None:
        """Before the first iteration; `history` has the metrics of those that an earlier process has done."""
        for plan in self._plans:
            if plan.resume:
                write_config(plan, self._env)
        for writer, columns in self._writers:
            writer.begin({name: rows[:, columns] for name, rows in history.items()})

    def write(self, progress: "Progress") -> None:
        """After each chunk of iterations."""
        steps = progress.metrics["env_steps"].size * self._steps_per_iteration
        self._steps += steps
        if steps:  # behaviour cloning takes none
            self._seconds += steps / progress.env_steps_per_second
        for writer, columns in self._writers:
            writer.write(progress.iteration, {name: rows[:, columns] for name, rows in progress.metrics.items()})

    def finish(self, summaries: Mapping[Path, Mapping[str, Any]]) -> None:
        """After the evaluation; `summaries` has the content of summary.json of each run folder."""
        for writer in self._elsewhere:
            writer.finish(summaries[writer.folder])

    @property
    def places(self) -> list[str]:
        """Where else than in the run folders the metrics can be seen."""
        return [writer.place for writer in self._elsewhere]

    @property
    def _elsewhere(self) -> list[WandbWriter]:
        return [writer for writer, _ in self._writers if isinstance(writer, WandbWriter)]

    @property
    def env_steps_per_second(self) -> float | None:
        """Of all runs together, without compilation; None where no step was taken."""
        return self._steps / self._seconds if self._seconds else None


def _writers_of(plan: RunPlan) -> list[MetricsWriter | WandbWriter]:
    """What the metrics of a run go to."""
    writers: list[MetricsWriter | WandbWriter] = [MetricsWriter(plan.folder)]
    if plan.wandb:
        setup = plan.setup
        facts = {"task": setup.task, "preset": plan.preset, "seed": setup.seed, "num_seeds": setup.num_seeds}
        config = {**dataclasses.asdict(plan.config), **facts, "command": plan.command}
        writers.append(WandbWriter(plan.wandb, plan.folder, config))
    return writers


def write_config(plan: RunPlan, env: Any) -> None:
    """Writes config.json of a run on the task `env`."""
    run_folder.write_config(plan.folder, plan.config, _facts(plan, env))


def _facts(plan: RunPlan, env: Any) -> dict[str, Any]:
    """What config.json says besides the hyperparameters."""
    import jax

    setup, demonstrations = plan.setup, None
    if setup.demonstrations_path is not None:
        demonstrations = {
            "file": str(setup.demonstrations_path.resolve()),
            "sha256": content_sha256(setup.demonstrations_path),
            "num_episodes": setup.num_demonstrations,
        }
    device = jax.devices()[0]
    return {
        "task": setup.task,
        "physics": options.engine_of(setup.task, env),
        "env_options": setup.env_options,
        "preset": plan.preset,
        "command": plan.command,
        "seed": setup.seed,
        "one_by_one": setup.one_by_one,
        "num_seeds": setup.num_seeds,
        "eval_episodes": setup.eval_episodes,
        "demonstrations": demonstrations,
        **summary.expert_levels(setup.demonstrations),
        "expert_length": setup.demonstrations.mean_episode_length if setup.demonstrations else None,
        "device": {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()},
    }
