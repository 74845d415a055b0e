"""Expert trajectories and their file format. NumPy only: launchers read files before JAX is imported.

A file is an `.npz` archive without pickled objects: `obs [n, obs_dim]`, `actions [n, action_dim]`, `rewards [n]`
(optional), `costs [n]`, `terminated [n]`, `truncated [n]`, `episode_ends [E]` and `metadata`, a JSON object as text.
Other formats are read too: see `formats`, beside this file. Files come from strangers, so nothing in them is trusted:
see `load_demonstrations`.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ccil_jax.demonstrations import columns, formats, npz
from ccil_jax.errors import DemonstrationsError

_FORMS: Mapping[str, Callable[[np.ndarray, str], np.ndarray]] = {
    "obs": columns.rows,
    "actions": columns.rows,
    "rewards": columns.per_step,
    "costs": columns.per_step,
    "terminated": columns.flags,
    "truncated": columns.flags,
    "episode_ends": columns.indices,
}
_NUMBER_KEYS = ("obs", "actions", "rewards", "costs")
_STEP_KEYS = (*_NUMBER_KEYS, "terminated", "truncated")
_REWRITE = "write the file with ccil_jax.save_demonstrations"


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
    """E episodes laid end to end in n steps; row t holds the observation in which action t was taken."""

    obs: np.ndarray  # [n, obs_dim] float32
    actions: np.ndarray  # [n, action_dim] float32
    rewards: np.ndarray | None  # [n] float32; None where the expert's reward is unknown
    costs: np.ndarray  # [n] float32, >= 0
    terminated: np.ndarray  # [n] bool: the task ended after this step
    truncated: np.ndarray  # [n] bool: the time limit was reached after this step
    episode_ends: np.ndarray  # [E] int64: index one past each episode's last step
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)  # task, method, versions, command, ...

    @property
    def num_steps(self) -> int:
        """n: steps of all episodes together."""
        return len(self.obs)

    @property
    def num_episodes(self) -> int:
        """E."""
        return len(self.episode_ends)

    @property
    def episode_lengths(self) -> np.ndarray:
        """[E] steps of each episode."""
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
        """J_E: what the learner's mean episode cost must not exceed (Algorithm 1 line 1)."""
        return float(np.mean(self.episode_costs))

    @property
    def mean_episode_return(self) -> float | None:
        """R_E; None without rewards."""
        returns = self.episode_returns
        return None if returns is None else float(np.mean(returns))

    @property
    def cost_standard_error(self) -> float | None:
        """How uncertain J_E is: its standard error over the episodes; None for a single one (docs/metrics.md)."""
        return standard_error(self.episode_costs)

    @property
    def return_standard_error(self) -> float | None:
        """How uncertain R_E is: its standard error over the episodes; None for a single one, or without rewards."""
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
        return Demonstrations(**steps, episode_ends=self.episode_ends[:count], metadata=dict(self.metadata))

    def _episode_sums(self, values: np.ndarray) -> np.ndarray:
        starts = np.concatenate([[0], self.episode_ends[:-1]])
        return np.add.reduceat(values.astype(np.float64), starts)


def standard_error(values: np.ndarray) -> float | None:
    """The standard error of the mean of `values [n]`; None for fewer than two, whose spread is unknown."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None


def load_demonstrations(path: str | os.PathLike[str], *, default_cost: float | None = None) -> Demonstrations:
    """Reads and checks demonstrations, ours or those of `ccil_jax.demonstrations.formats`, recognised by content.

    Runs no code from the file and unpacks at most `npz.MAX_BYTES`. `default_cost` is taken for every step where a
    file of another format has no costs, and the metadata say so; without it such a file is refused.

    Raises `DemonstrationsError`, one line with file, key and remedy, for anything that is not a sound file.
    """
    path = Path(path)
    try:
        read = formats.reader_of(path)
        arrays = _read_own(path) if read is None else read(path)
    except npz.ArchiveError as error:
        raise DemonstrationsError(str(error)) from None
    if arrays["costs"] is None:
        if default_cost is None:
            raise DemonstrationsError(f"{path}: {formats.NO_COSTS}")
        arrays["costs"] = np.full(len(arrays["obs"]), default_cost, np.float32)
        arrays["metadata"] = {**arrays["metadata"], "default_cost": default_cost}  # nobody has measured these costs
    return _checked(arrays, str(path))


def _read_own(path: Path) -> dict[str, Any]:
    arrays: dict[str, Any] = {"rewards": None}
    arrays.update(npz.read(path, (*_FORMS, "metadata"), optional=frozenset({"rewards"}), remedy=_REWRITE))
    arrays["metadata"] = _parse_metadata(arrays["metadata"], path)
    return arrays


def save_demonstrations(path: str | os.PathLike[str], demonstrations: Demonstrations) -> None:
    """Checks and writes a compressed `.npz`, whole or not at all; equal data give equal bytes.

    Raises `DemonstrationsError` for data that `load_demonstrations` would refuse, and `OSError` from the disk.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise DemonstrationsError(f"{path}: a demonstrations file is named *.npz")
    checked = _checked({f.name: getattr(demonstrations, f.name) for f in dataclasses.fields(Demonstrations)}, str(path))
    arrays = {key: value for key in _FORMS if (value := getattr(checked, key)) is not None}
    try:
        text = json.dumps(checked.metadata, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DemonstrationsError(f"{path}: 'metadata' is not JSON ({error}); use plain numbers and text") from None
    npz.write(path, {**arrays, "metadata": np.array(text)})


def check_matches(demonstrations: Demonstrations, path: str | os.PathLike[str], task: TaskInfo) -> None:
    """Raises `DemonstrationsError` if the file `path` is of another task or of other dimensions than `task`."""
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
    """Raises `DemonstrationsError`, which begins with `source`, if a trajectory is longer than the learner's episodes.

    The learner's cost limit is the mean cost of a demonstrated episode. An episode of the learner that is cut off
    earlier has fewer steps in which to cost anything, so the constraint would never bind, and nothing would show that.
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


def _parse_metadata(array: np.ndarray, path: Path) -> dict[str, Any]:
    try:
        if array.nbytes > formats.MAX_METADATA_BYTES or (array.dtype != np.uint8 and array.ndim):
            raise ValueError("not a text of reasonable length")
        text = array.tobytes().decode() if array.dtype == np.uint8 else str(array.astype(np.str_)[()])
        metadata = json.loads(text.removeprefix("\ufeff"))  # some editors begin a text with a byte order mark
    except (ValueError, RecursionError):
        metadata = None
    if not isinstance(metadata, dict):
        raise DemonstrationsError(f"{path}: 'metadata' is not a JSON object as text; {_REWRITE}")
    return metadata


def _checked(arrays: Mapping[str, Any], source: str) -> Demonstrations:
    """The arrays, in their final types, as sound `Demonstrations`; `source` begins every complaint."""
    known = [key for key in _FORMS if key != "rewards" or arrays[key] is not None]
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
    checked = Demonstrations(**{"rewards": None, **converted}, metadata=dict(arrays["metadata"]))
    _check_values(checked, source)
    return checked


def _convert(value: Any, key: str, source: str) -> np.ndarray:
    """`value` in the form and the type that `key` has."""
    try:
        array = _FORMS[key](np.asarray(value), f"{source}: '{key}'")
    except npz.ArchiveError as error:
        raise DemonstrationsError(str(error)) from None
    if key not in _NUMBER_KEYS:
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


def _check_values(checked: Demonstrations, source: str) -> None:
    def fail(key: str, row: int, complaint: str) -> None:
        trajectory = int(np.searchsorted(checked.episode_ends, row, side="right"))
        raise DemonstrationsError(f"{source}: '{key}' {complaint} (trajectory {trajectory}, row {row})")

    for key in _NUMBER_KEYS:
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
