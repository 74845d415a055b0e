"""The numbers of metrics.csv in Weights & Biases, where a run is given a project there (`--wandb PROJECT`).

Whether they are sent or kept is Weights & Biases' own setting: with `WANDB_MODE=offline` they stay in the run folder,
from where `wandb sync` sends them.
"""

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from experiments.cli.command_line import UsageError
from experiments.runs.metrics_file import columns_of, rows_of, tagged

_STAYS_HERE = ("offline", "dryrun", "disabled")  # modes of wandb that need no account


def check(project: str) -> None:
    """Raises `UsageError` where nothing could be logged: no package, no such project, or nobody is logged in."""
    if importlib.util.find_spec("wandb") is None:
        raise UsageError(f"--wandb {project}: needs the package wandb; install it with `pip install 'ccil_jax[wandb]'`")
    import wandb

    try:
        wandb.Settings(project=project)
        ready = wandb.setup().settings.mode in _STAYS_HERE or wandb.login(prompt=False)
    except wandb.errors.Error as error:
        raise UsageError(f"--wandb {project}: {error}; correct it") from None
    if not ready:
        raise UsageError(
            f"--wandb {project}: nobody is logged in on this machine; do `wandb login`, or set WANDB_MODE=offline to "
            "send the run later"
        )


class WandbWriter:
    """Hands metrics to Weights & Biases, a chunk of iterations at a time; use it as a context manager.

    A run that is resumed is a new run there, which begins with the metrics of all iterations that have been done. The
    names of the metrics are those of the TensorBoard events, and so are the steps.

    Args:
        project: at Weights & Biases.
        folder: of the run, whose name becomes that of the run there.
        config: what is listed there as the configuration of the run.

    Raises:
        UsageError: Weights & Biases cannot be reached.
    """

    def __init__(self, project: str, folder: Path, config: Mapping[str, Any]) -> None:
        import wandb

        self.folder = folder
        settings = wandb.Settings(silent=True, console="off", reinit="create_new")  # several runs may share a process
        try:
            self._run = wandb.init(
                project=project, name=folder.name, dir=folder, config=dict(config), settings=settings
            )
        except wandb.errors.Error as error:
            raise UsageError(
                f"--wandb {project}: the run cannot begin ({error}); set WANDB_MODE=offline to send it later"
            ) from None
        self._run.define_metric("*", step_metric="env_steps")

    @property
    def place(self) -> str:
        """Where the run can be seen: an address, or the command that sends it."""
        return f"wandb sync {self._run.settings.sync_dir}" if self._run.offline else str(self._run.url or "off")

    def begin(self, history: Mapping[str, np.ndarray]) -> None:
        """Logs the metrics `[iterations, num_seeds]` of a checkpoint; {} for a new run."""
        if history:
            self.write(len(history["env_steps"]), history)

    def write(self, iteration: int, metrics: Mapping[str, np.ndarray]) -> None:
        """Logs the metrics `[chunk, num_seeds]`; with the last of them `iteration` iterations are done."""
        names = columns_of(metrics)
        rows = rows_of(metrics, names)
        for number, row in enumerate(rows, iteration - len(rows) + 1):
            steps, values = tagged(number, names, row)
            self._run.log({**values, "env_steps": steps, "iteration": number})

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Logs the scores of the evaluation, of each seed and their mean; `summary` is the content of summary.json."""
        of_seeds = {
            f"seed_{row['seed']}/{name}": row[name] for row in summary["per_seed"] for name in row if name != "seed"
        }
        means = {f"mean/{name}": score and score["mean"] for name, score in summary["aggregate"].items()}
        scores = {**of_seeds, **means}
        self._run.summary.update({f"evaluation/{name}": score for name, score in scores.items() if score is not None})

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._run.finish(exit_code=0 if kind is None else 1)
