"""Reads policies from the NumPy files that `evaluate --export` and `expert --export` write, and experts are shipped in.

The files may be from strangers: they are read without pickle, and everything in them is checked before it is used.
"""

import dataclasses
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.config import CHOICES, Config
from ccil_jax.demonstrations import npz
from ccil_jax.demonstrations.npz import ArchiveError
from envs.lookup import hint
from envs.registry import TASKS
from experiments.cli.command_line import UsageError, launcher_command
from experiments.policies.numpy_policy import CLIP

MAX_LAYERS = 32
_AGAIN = "write the file again with `evaluate --export`"
_GAUSSIAN, _SQUASHED = ("action_std",), ("action_center", "action_half_range")
_OBSERVED = ("obs_mean", "obs_std", "obs_clip")
_BOUNDS = ("action_low", "action_high")  # which files of earlier versions lack, the shipped ones among them
_EPISODES = ("episode_return", "episode_cost")
_TRAINING = {"task": str, "method": str, "env_options": dict, "physics": str}  # what has to be known of a training


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyFile:
    """The content of a file: S policies of one training. All arrays are [S]-leading."""

    path: Path
    metadata: dict[str, Any]
    layers: list[tuple[np.ndarray, np.ndarray]]  # kernels [S, from, to] and biases [S, to]
    last: dict[str, np.ndarray]  # `action_std`, or `action_center` and `action_half_range` of squashed policies
    observed: dict[str, np.ndarray]  # `obs_mean` and `obs_std` [S, obs_dim], `obs_clip` [S]
    episodes: dict[str, np.ndarray]  # `episode_return` and `episode_cost` [S, E], of those played when it was written

    @property
    def squashed(self) -> bool:
        """Whether actions are drawn from a tanh-Gaussian (IQ-Learn)."""
        return "action_std" not in self.last

    @property
    def num_policies(self) -> int:
        """S."""
        return len(self.layers[0][0])

    @property
    def training(self) -> dict[str, Any]:
        """How the policies were trained: `recording.training`, and `seed_indices`, the seed of each policy."""
        training: dict[str, Any] = self.metadata["training"]
        return training

    @property
    def config(self) -> Config:
        """A configuration with a policy of this form. Its method is a built-in one: what a file names is not run."""
        return Config(
            method="iq_learn" if self.squashed else "trpo",
            hidden_sizes=tuple(bias.shape[1] for _, bias in self.layers[:-1]),
            activation=self.metadata["activation"],
            evaluated_action=self.training.get("evaluated_action", "sample"),  # which files of earlier versions lack
        )

    def check_sizes(self, obs_dim: int, action_dim: int) -> None:
        """Raises `ArchiveError` where the policies do not fit a task with these sizes."""
        found = self.layers[0][0].shape[1], self.layers[-1][1].shape[1] // (2 if self.squashed else 1)
        if found != (obs_dim, action_dim):
            raise ArchiveError(
                f"{self.path}: policies with {found[0]} observations and {found[1]} actions, but "
                f"{self.training['task']} has {obs_dim} and {action_dim}; {_AGAIN}"
            )

    def actor(self) -> Any:
        """The policies as a `ccil_jax.acting.rollout.Actor`, [S]-leading."""
        import jax.numpy as jnp

        from ccil_jax.acting.rollout import Actor
        from ccil_jax.acting.running_statistics import RunningStatistics

        real = jnp.result_type(float)
        layers = {
            f"Dense_{i}": {"kernel": jnp.asarray(kernel, real), "bias": jnp.asarray(bias, real)}
            for i, (kernel, bias) in enumerate(self.layers)
        }
        network = {"params": layers}
        if self.squashed:
            return Actor(policy_params={"squashed": network}, obs_statistics=None)
        statistics = RunningStatistics(
            count=jnp.ones(self.num_policies, real),
            mean=jnp.asarray(self.observed["obs_mean"], real),
            sum_squares=jnp.asarray(self.observed["obs_std"] ** 2, real),
        )
        log_std = jnp.asarray(np.log(self.last["action_std"]), real)
        return Actor(policy_params={"mean": network, "log_std": log_std}, obs_statistics=statistics)


def shipped() -> Path:
    """The folder of the experts that are shipped, one file a task."""
    return Path(str(resources.files("experiments"))) / "experts"


def find(named: Path, option: str) -> Path:
    """The file itself; or that of a shipped expert, where `named` is the name of its task and no file.

    Raises:
        UsageError: there is no such file, and the name is that of a task whose expert is not shipped, or of none.
    """
    if named.exists() or len(named.parts) > 1 or named.suffix:
        return named
    known = shipped() / f"{named.name}.npz"
    if known.is_file():
        return known
    names = sorted(path.stem for path in shipped().glob("*.npz"))
    remedy = f"{hint(named.name, names)}correct the path or the name"
    if named.name in TASKS:
        train = f"{launcher_command('expert')} --env {named} --out {named}.npz --export {named}_policy.npz"
        remedy = f"train one with `{train}`"
    raise UsageError(
        f"{option} {named}: no such file, and no expert of that name is shipped (shipped: {', '.join(names)}); {remedy}"
    )


def read(path: Path) -> PolicyFile:
    """Reads and checks a file. Imports no JAX. Raises `ArchiveError`, which names file, key and remedy."""
    layers = [f"{kind}_{i}" for i in range(MAX_LAYERS) for kind in ("kernel", "bias")]
    optional = frozenset({*layers[2:], *_GAUSSIAN, *_SQUASHED, *_BOUNDS, *_EPISODES})
    names = (*layers, *_GAUSSIAN, *_SQUASHED, *_OBSERVED, *_BOUNDS, *_EPISODES, "metadata")
    arrays = npz.read(path, names, optional=optional, remedy=_AGAIN)
    metadata = npz.json_object(arrays.pop("metadata"), f"{path}: 'metadata'", _AGAIN)
    _check_metadata(path, metadata)
    for name, values in arrays.items():
        if values.dtype.kind != "f" or not (np.isfinite(values).all() or name in ("obs_clip", *_BOUNDS)):
            raise ArchiveError(f"{path}: '{name}' holds something else than finite numbers; {_AGAIN}")
    last = _GAUSSIAN if "action_std" in arrays else _SQUASHED
    depth = sum(name.startswith("kernel_") for name in arrays)
    shapes = {name: values.shape for name, values in arrays.items()}
    try:
        num, obs_dim = shapes["kernel_0"][:2]
        width = obs_dim
        for i in range(depth):
            _same(shapes[f"kernel_{i}"][:2], (num, width))
            width = shapes[f"kernel_{i}"][2]
            _same(shapes[f"bias_{i}"], (num, width))
        action_dim = width if last == _GAUSSIAN else width // 2
        for name, shape in {**dict.fromkeys(last, (num, action_dim)), "obs_clip": (num,)}.items():
            _same(shapes[name], shape)
        _same(shapes["obs_mean"], (num, obs_dim))
        _same(shapes["obs_std"], (num, obs_dim))
        if set(_BOUNDS) & arrays.keys():
            low, high = (arrays[name] for name in _BOUNDS)
            _same((low.shape, high.shape, bool((low <= high).all())), (shapes[last[0]], shapes[last[0]], True))
        for name in set(_EPISODES) & arrays.keys():
            _same((len(shapes[name]), shapes[name][:1]), (2, (num,)))
        if last == _GAUSSIAN:
            _same(tuple(arrays["obs_clip"]), (CLIP,) * num)
        _same((depth > 1, num > 0, len(metadata["training"]["seed_indices"])), (True, True, num))
    except (LookupError, ValueError):
        raise ArchiveError(f"{path}: its arrays do not make up a policy together; {_AGAIN}") from None
    for name in ("action_std", "obs_std"):
        if name in arrays and arrays[name].min() <= 0:
            raise ArchiveError(f"{path}: '{name}' holds deviations that are not positive; {_AGAIN}")
    return PolicyFile(
        path=path,
        metadata=metadata,
        layers=[(arrays[f"kernel_{i}"], arrays[f"bias_{i}"]) for i in range(depth)],
        last={name: arrays[name] for name in last},
        observed={name: arrays[name] for name in _OBSERVED},
        episodes={name: arrays[name] for name in _EPISODES if name in arrays},
    )


def _same(found: tuple[Any, ...], wanted: tuple[Any, ...]) -> None:
    if found != wanted:
        raise ValueError


def _check_metadata(path: Path, metadata: dict[str, Any]) -> None:
    """Raises `ArchiveError` where something is missing that has to be known of the policies."""
    training = metadata.get("training")
    if not isinstance(training, dict):
        raise ArchiveError(f"{path}: 'metadata' does not say how the policies were trained; {_AGAIN}")
    for name, kind in _TRAINING.items():
        if not isinstance(training.get(name), kind):
            raise ArchiveError(f"{path}: 'metadata' has no sound training.{name}; {_AGAIN}")
    indices, limit = training.get("seed_indices"), training.get("cost_limit")
    if not (isinstance(indices, list) and all(type(index) is int for index in indices)):
        raise ArchiveError(f"{path}: 'metadata' has no sound training.seed_indices; {_AGAIN}")
    if not (limit is None or type(limit) in (int, float)):
        raise ArchiveError(f"{path}: 'metadata' has no sound training.cost_limit; {_AGAIN}")
    if metadata.get("activation") not in CHOICES["activation"]:
        raise ArchiveError(f"{path}: 'metadata' has no known activation; {_AGAIN}")
    if training.get("evaluated_action", "sample") not in CHOICES["evaluated_action"]:
        raise ArchiveError(f"{path}: 'metadata' has no known training.evaluated_action; {_AGAIN}")
    levels = metadata.get("levels")
    if not (isinstance(levels, dict) and all(x is None or type(x) in (int, float) for x in levels.values())):
        raise ArchiveError(f"{path}: 'metadata' has no sound levels of an expert; {_AGAIN}")
