"""What a training is asked to do besides its hyperparameters."""

import dataclasses
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from ccil_jax.config import field_names, is_integer
from ccil_jax.errors import ConfigError
from ccil_jax.training.loop import History, Progress

LARGEST_INTEGER = 2**31 - 1  # of a 32-bit signed integer
LARGEST_SEED = 2**32 - 1  # of a 32-bit unsigned integer: `jax.random.key` would drop the bits beyond


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """The keyword arguments of `runner.train`, which documents them. Creating an object checks their values.

    Raises:
        ConfigError: a value is not possible, or has no effect beside the others.
    """

    num_seeds: int
    seed: int
    one_by_one: bool
    checkpoint_dir: str | Path | None
    resume: bool
    moved: Collection[str]
    verbose: bool
    on_start: Callable[[History], None] | None
    on_progress: Callable[[Progress], None] | None
    should_stop: Callable[[], bool] | None
    stop_after: int | None

    def __post_init__(self) -> None:
        _check_integer("num_seeds", self.num_seeds, 1, LARGEST_INTEGER)
        _check_integer("seed", self.seed, 0, LARGEST_SEED)
        _check_integer("stop_after", 0 if self.stop_after is None else self.stop_after, 0, LARGEST_INTEGER)
        for name in ("one_by_one", "resume", "verbose"):
            value = getattr(self, name)
            if not isinstance(value, bool):
                raise ConfigError(f"{name} {value!r}: give True or False")
        if self.resume and self.checkpoint_dir is None:
            raise ConfigError("resume True: there is nothing to go on from; give checkpoint_dir")
        if self.moved and not self.resume:
            raise ConfigError(
                f"moved {', '.join(self.moved)}: for a training that is resumed; leave it out, or add resume=True"
            )
        if static := set(self.moved) - set(field_names(traced=True)):
            raise ConfigError(f"moved {min(static)}: only a traced field may differ from the training that is resumed")


def _check_integer(name: str, value: Any, least: int, most: int) -> None:
    if not (is_integer(value) and least <= int(value) <= most):
        raise ConfigError(f"{name} {value!r}: give an integer from {least} to {most}")
