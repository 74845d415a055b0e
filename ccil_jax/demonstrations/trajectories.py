"""Expert trajectories: the container, and reading, checking and writing it.

Only NumPy is imported, because launchers read files before they import JAX. The formats of files are in `formats`,
beside this file. Files come from strangers, so nothing in them is trusted: see `load_demonstrations`.
"""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ccil_jax.demonstrations import columns, formats, minari_datasets, npz, own
from ccil_jax.demonstrations.formats import Format
from ccil_jax.errors import DemonstrationsError

_NUMBER_KEYS = ("obs", "actions", "rewards", "costs")
_STEP_KEYS = (*_NUMBER_KEYS, "terminated", "truncated")
_FLOAT_KEYS = (*_NUMBER_KEYS, "final_obs")


class TaskInfo(Protocol):
    """What `check_matches` needs to know of a task."""

    @property
    def name(self) -> str:
        """Key of `envs.TASKS`."""

    @property
    def obs_dim(self) -> int | None:
        """Entries of an observation; None where they are not known before the task is built."""

    @property
    def action_dim(self) -> int | None:
        """Entries of an action; None where they are not known before the task is built."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Demonstrations:
    """E episodes of n steps in all, one after the other. Row t holds the observation in which action t was taken."""

    obs: np.ndarray  # [n, obs_dim] float32
    actions: np.ndarray  # [n, action_dim] float32
    rewards: np.ndarray | None  # [n] float32; None where the expert's reward is unknown
    costs: np.ndarray  # [n] float32, >= 0
    terminated: np.ndarray  # [n] bool: the task ended after this step
    truncated: np.ndarray  # [n] bool: the time limit was reached after this step
    episode_ends: np.ndarray  # [E] int64: one more than the index of each episode's last step
    final_obs: np.ndarray | None = (
        None  # [E, obs_dim] float32: the observation after each episode's last step, if known
    )
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)  # for example task, method, versions, command

    @property
    def num_steps(self) -> int:
        """n, the number of steps of all episodes together."""
        return len(self.obs)

    @property
    def num_episodes(self) -> int:
        """E, the number of episodes."""
        return len(self.episode_ends)

    @property
    def episode_lengths(self) -> np.ndarray:
        """[E] the number of steps of each episode."""
        return np.diff(self.episode_ends, prepend=0)

    @property
    def episode_returns(self) -> np.ndarray | None:
        """[E] undiscounted sums of reward; None without rewards."""
        return None if self.rewards is None else self._episode_sums(self.rewards)

    @property
    def episode_costs(self) -> np.ndarray:
        """[E] undiscounted sums of cost."""
        return self._episode_sums(self.costs)

    @property
    def mean_episode_cost(self) -> float:
        """J_E, the mean cost of an episode: what that of the learner must not exceed (Algorithm 1 line 1)."""
        return float(np.mean(self.episode_costs))

    @property
    def mean_episode_return(self) -> float | None:
        """R_E, the mean return of an episode; None without rewards."""
        returns = self.episode_returns
        return None if returns is None else float(np.mean(returns))

    @property
    def cost_standard_error(self) -> float | None:
        """The standard error of J_E over the episodes; None for a single episode (docs/metrics.md)."""
        return standard_error(self.episode_costs)

    @property
    def return_standard_error(self) -> float | None:
        """The standard error of R_E over the episodes; None for a single episode, or without rewards."""
        returns = self.episode_returns
        return None if returns is None else standard_error(returns)

    @property
    def mean_episode_length(self) -> float:
        """Mean steps per episode."""
        return float(np.mean(self.episode_lengths))

    def take_episodes(self, count: int) -> "Demonstrations":
        """The first `count` episodes. Raises `DemonstrationsError` unless 1 <= count <= E."""
        if not 1 <= count <= self.num_episodes:
            raise DemonstrationsError(f"{count} trajectories asked for; choose between 1 and {self.num_episodes}")
        end = int(self.episode_ends[count - 1])
        steps: dict[str, Any] = {key: None if (v := getattr(self, key)) is None else v[:end] for key in _STEP_KEYS}
        return Demonstrations(
            **steps,
            episode_ends=self.episode_ends[:count],
            final_obs=None if self.final_obs is None else self.final_obs[:count],
            metadata=dict(self.metadata),
        )

    def _episode_sums(self, values: np.ndarray) -> np.ndarray:
        starts = np.concatenate([[0], self.episode_ends[:-1]])
        return np.add.reduceat(values.astype(np.float64), starts)


def standard_error(values: np.ndarray) -> float | None:
    """The standard error of the mean of `values [n]`; None for fewer than two, from which it cannot be estimated."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None


def load_demonstrations(
    path: str | os.PathLike[str], *, default_cost: float | None = None, file_format: Format | None = None
) -> Demonstrations:
    """Reads and checks demonstrations of any format in `formats.FORMATS`, which is recognised by content.

    The package's own readers run no code from a file, and unpack at most `npz.MAX_BYTES`. Every value is checked,
    whichever reader it comes from.

    Args:
        path: a file, the folder of a dataset, or `minari:ID`, a dataset among the local ones of Minari.
        default_cost: taken as the cost of every step where the file has no costs; the metadata say so then. Without
            it, such a file is refused.
        file_format: read the file as one of this format, whether it is recognised and registered or not.

    Raises:
        DemonstrationsError: this is no sound file. The message is one line with file, key and remedy.
    """
    path = minari_datasets.locate(path)
    chosen = formats.format_of(path) if file_format is None else file_format
    arrays = formats.read(path, chosen)
    if arrays["costs"] is None:
        if default_cost is None:
            where = f" ({chosen.costs})" if chosen.costs else ""
            raise DemonstrationsError(
                f"{path}: holds no cost of each step{where}; constrained methods need it (`convert --default-cost 0` "
                "for gail)"
            )
        num_steps = len(_convert(arrays["obs"], "obs", str(path)))
        arrays["costs"] = np.full(num_steps, default_cost, np.float32)
        arrays["metadata"] = {**arrays["metadata"], "default_cost": default_cost}  # nobody has measured these costs
    return _checked(arrays, str(path))


def save_demonstrations(path: str | os.PathLike[str], demonstrations: Demonstrations) -> None:
    """Checks the demonstrations and writes them, whole or not at all. What is there under that name is replaced.

    Args:
        path: `NAME.npz` for a compressed file of our own format, of which equal demonstrations give equal bytes;
            `NAME.hdf5` or `NAME.h5` for a file with DSRL's datasets; `minari:ID` for a dataset among the local ones of
            Minari. The last two need the rewards and the observation after each episode's last step.
        demonstrations: what to write.

    Raises:
        DemonstrationsError: the name is none of these, the format's library is missing, arrays are missing, or
            `load_demonstrations` would refuse the demonstrations.
        OSError: the disk is full or cannot be written to.
    """
    path = Path(path)
    write = formats.writer_of(path)
    checked = _checked({f.name: getattr(demonstrations, f.name) for f in dataclasses.fields(Demonstrations)}, str(path))
    if write is not own.write:
        _check_complete(checked, str(path))
    try:
        json.dumps(checked.metadata, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DemonstrationsError(f"{path}: 'metadata' is not JSON ({error}); use plain numbers and text") from None
    write(path, {key: getattr(checked, key) for key in columns.FORMS}, checked.metadata)


def _check_complete(checked: Demonstrations, source: str) -> None:
    if checked.rewards is None:
        raise DemonstrationsError(f"{source}: needs rewards, which these demonstrations do not have; write .npz")
    if checked.final_obs is None:
        raise DemonstrationsError(
            f"{source}: needs the observation after each episode's last step, which these demonstrations do not have "
            "('final_obs'); record them again with `evaluate RUN_DIR --record FILE` or "
            "`evaluate --policy TASK --record FILE`, or write .npz"
        )


def check_matches(demonstrations: Demonstrations, path: str | os.PathLike[str], task: TaskInfo) -> None:
    """Raises `DemonstrationsError` if the demonstrations from the file `path` are of another task than `task`.

    That is, if they say so themselves, or if their observations or actions have other dimensions.
    """
    recorded = demonstrations.metadata.get("task", task.name)
    if recorded != task.name:
        raise DemonstrationsError(
            f"{path}: recorded on task {recorded!r}, not {task.name!r}; use --env {recorded} or another --demos file"
        )
    for key, name in (("obs", "obs_dim"), ("actions", "action_dim")):
        found, wanted = getattr(demonstrations, key).shape[1], getattr(task, name)
        if wanted not in (None, found):
            raise DemonstrationsError(
                f"{path}: '{key}' has {found} columns, {task.name} has {name} {wanted}; use a file of this task"
            )


def check_time_limit(demonstrations: Demonstrations, source: str | os.PathLike[str], max_episode_steps: int) -> None:
    """Raises `DemonstrationsError` if a trajectory is longer than an episode of the learner can be.

    The learner's cost limit is the mean cost of a demonstrated episode. If the learner's episodes end earlier, there
    are fewer steps at which a cost can arise, so the learner could keep the limit without any constraint, and nothing
    would show this. `source` begins the message.
    """
    lengths = demonstrations.episode_lengths
    longest = int(np.argmax(lengths))
    if lengths[longest] > max_episode_steps:
        raise DemonstrationsError(
            f"{source}: trajectory {longest} has {lengths[longest]} steps, an episode of this run has at most "
            f"{max_episode_steps}; the cost limit is the mean cost of a demonstrated episode, so in shorter episodes "
            f"the constraint would never bind; use --max-episode-steps {lengths[longest]} (in Python: "
            "max_episode_steps) or other demonstrations"
        )


def _checked(arrays: Mapping[str, Any], source: str) -> Demonstrations:
    """Demonstrations of these arrays, converted to their final types and checked; `source` begins every message."""
    known = [key for key in columns.FORMS if key not in columns.OPTIONAL or arrays[key] is not None]
    converted: dict[str, Any] = {key: _convert(arrays[key], key, source) for key in known}
    num_steps = len(converted["obs"])
    if num_steps == 0:
        raise DemonstrationsError(f"{source}: 'obs' is empty; record at least one episode")
    for key in _STEP_KEYS:
        if key in converted and len(converted[key]) != num_steps:
            raise DemonstrationsError(
                f"{source}: '{key}' has {len(converted[key])} rows, 'obs' has {num_steps}; they must be equal"
            )
    _check_episode_ends(converted["episode_ends"], num_steps, source)
    _check_final_obs(converted, source)
    checked = Demonstrations(**{**dict.fromkeys(columns.OPTIONAL), **converted}, metadata=dict(arrays["metadata"]))
    _check_values(checked, source)
    return checked


def _convert(value: Any, key: str, source: str) -> np.ndarray:
    """`value` as an array of the shape and the type that `Demonstrations` has under this key."""
    try:
        array = columns.FORMS[key](np.asarray(value), f"{source}: '{key}'")
    except npz.ArchiveError as error:
        raise DemonstrationsError(str(error)) from None
    except (ValueError, TypeError):  # from NumPy
        raise DemonstrationsError(f"{source}: '{key}' cannot be turned into an array of numbers; correct it") from None
    if key not in _FLOAT_KEYS:
        return array
    with np.errstate(over="ignore", invalid="ignore"):  # what does not fit float32 is reported as not finite
        return array.astype(np.float32)


def _check_episode_ends(ends: np.ndarray, num_steps: int, source: str) -> None:
    if len(ends) == 0:
        raise DemonstrationsError(f"{source}: 'episode_ends' is empty (zero episodes); record at least one episode")
    bad = np.flatnonzero(np.diff(ends, prepend=0) <= 0)
    if len(bad):
        raise DemonstrationsError(
            f"{source}: 'episode_ends' does not increase at trajectory {bad[0]} ({ends[bad[0]]}); "
            "each entry is the index one past an episode's last step"
        )
    if ends[-1] != num_steps:
        raise DemonstrationsError(
            f"{source}: 'episode_ends' covers {ends[-1]} of {num_steps} rows; the last entry must be {num_steps}"
        )


def _check_final_obs(arrays: Mapping[str, np.ndarray], source: str) -> None:
    wanted = (len(arrays["episode_ends"]), arrays["obs"].shape[1])
    if "final_obs" in arrays and arrays["final_obs"].shape != wanted:
        raise DemonstrationsError(
            f"{source}: 'final_obs' has shape {arrays['final_obs'].shape}, must have shape {wanted}: the observation "
            "after each trajectory's last step"
        )


def _check_values(checked: Demonstrations, source: str) -> None:
    def fail(key: str, row: int, complaint: str) -> None:
        trajectory = row if key == "final_obs" else int(np.searchsorted(checked.episode_ends, row, side="right"))
        raise DemonstrationsError(f"{source}: '{key}' {complaint} (trajectory {trajectory}, row {row})")

    for key in _FLOAT_KEYS:
        value = getattr(checked, key)
        if value is not None:
            finite = np.isfinite(value).reshape(len(value), -1).all(axis=1)
            if not finite.all():
                fail(key, int(np.argmin(finite)), "holds NaN or infinity; remove that trajectory")
    if (checked.costs < 0).any():
        fail("costs", int(np.argmax(checked.costs < 0)), "is negative; costs are at least 0")
    inside = np.ones(checked.num_steps, np.bool_)
    inside[checked.episode_ends - 1] = False
    for key in ("terminated", "truncated"):
        early = getattr(checked, key) & inside
        if early.any():
            fail(key, int(np.argmax(early)), "is true before the trajectory's last step; correct 'episode_ends'")
