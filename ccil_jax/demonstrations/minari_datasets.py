"""The datasets that Minari has on this machine: the names `minari:ID`, where they are, and making new ones.

Minari's own package says where its datasets are and makes them. They are read by `minari`, beside this file, which
trusts nothing in them.
"""

import contextlib
import copy
import importlib.util
import json
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.errors import DemonstrationsError

PREFIX = "minari:"
_ID = re.compile(r"([\w-][\w/-]*[\w-]/)?[\w-]+-v\d+", re.ASCII)  # as Minari has it
_FOLDER_VARIABLE = "MINARI_DATASETS_PATH"  # where Minari looks for its datasets


def is_name(path: str | os.PathLike[str]) -> bool:
    """Whether this is the name of a local dataset, `minari:ID`, and not that of a file or folder."""
    return os.fspath(path).startswith(PREFIX)


def folder_of(path: str | os.PathLike[str]) -> Path:
    """The folder of the local dataset that `minari:ID` names, whether it is there or not. Nothing is downloaded.

    Raises:
        DemonstrationsError: this is no such name, or the package minari is missing, or it has no folder for datasets.
    """
    name = os.fspath(path)
    identifier = name.removeprefix(PREFIX)
    if not _ID.fullmatch(identifier):
        raise DemonstrationsError(
            f"{name}: not the name of a dataset; give one such as {PREFIX}mujoco/hopper/expert-v0"
        )
    if importlib.util.find_spec("minari") is None:
        raise DemonstrationsError(f"{name}: needs the package minari; install it with `pip install 'ccil_jax[minari]'`")
    return root() / identifier


def root() -> Path:
    """The folder of the local datasets. Raises `DemonstrationsError` where Minari cannot make it."""
    from minari.storage import get_dataset_path

    try:
        return Path(get_dataset_path())
    except OSError as error:
        raise DemonstrationsError(
            f"{error.filename}: Minari's folder of datasets cannot be made ({error.strerror}); set "
            f"{_FOLDER_VARIABLE} to another"
        ) from None


def locate(path: str | os.PathLike[str]) -> Path:
    """The path itself, or the folder of the local dataset where it is a name `minari:ID`.

    Raises:
        DemonstrationsError: there is no such dataset on this machine.
    """
    if not is_name(path):
        return Path(path)
    folder = folder_of(path)
    if not folder.is_dir():
        name = os.fspath(path)
        raise DemonstrationsError(
            f"{name}: no such dataset on this machine ({folder}); download it with `minari download "
            f"{name.removeprefix(PREFIX)}`"
        )
    return folder


def write(path: Path, arrays: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Makes the local dataset `minari:ID` by Minari's own functions, whole or not at all; an existing one is replaced.

    The costs are in `infos/cost`, where a zero for the reset comes first, as in every array of infos that Minari itself
    records. Where gymnasium knows the task, the dataset names it, so that `recover_environment` builds it.

    Args:
        path: the name `minari:ID`.
        arrays: those of `Demonstrations`, checked, none missing.
        metadata: a JSON object, which becomes the description of the dataset, as text. `task` and `env_options` say
            what was recorded.

    Raises:
        DemonstrationsError: this is no name of a dataset, or minari is missing.
        OSError: the disk is full or cannot be written to.
    """
    folder, identifier = folder_of(path), os.fspath(path).removeprefix(PREFIX)
    import gymnasium
    from minari import create_dataset_from_buffers
    from minari.namespace import create_namespace, list_local_namespaces

    obs, actions = arrays["obs"], arrays["actions"]
    spec = _spec_of(metadata)
    spaces: dict[str, Any] = {}
    if spec is None:
        spaces["observation_space"], spaces["action_space"] = (
            gymnasium.spaces.Box(-np.inf, np.inf, (part.shape[1],), np.float32) for part in (obs, actions)
        )
    with tempfile.TemporaryDirectory(dir=root(), prefix=".") as temporary:
        with _datasets_in(temporary), warnings.catch_warnings():
            # About an author, a permanent link and the like, which nobody has given.
            warnings.filterwarnings("ignore", category=UserWarning, module="minari")
            create_dataset_from_buffers(
                identifier,
                list(_buffers(arrays)),
                env=spec,
                algorithm_name=str(metadata.get("method", "unknown")),
                description=json.dumps(metadata, sort_keys=True),
                **spaces,
            )
        namespace = identifier.rpartition("/")[0]
        if namespace and namespace not in list_local_namespaces():
            create_namespace(namespace)
        if folder.exists():
            shutil.rmtree(folder)
        (Path(temporary) / identifier).rename(folder)


def _buffers(arrays: Mapping[str, Any]) -> Iterator[Any]:
    """Each episode as Minari's functions take it."""
    from minari.data_collector import EpisodeBuffer

    starts = [0, *arrays["episode_ends"][:-1]]
    for start, end, final in zip(starts, arrays["episode_ends"], arrays["final_obs"], strict=True):
        yield EpisodeBuffer(
            observations=np.concatenate([arrays["obs"][start:end], final[None]]),
            actions=arrays["actions"][start:end],
            rewards=arrays["rewards"][start:end],
            terminations=arrays["terminated"][start:end],
            truncations=arrays["truncated"][start:end],
            infos={"cost": np.concatenate([np.zeros(1, np.float32), arrays["costs"][start:end]])},
        )


def _spec_of(metadata: Mapping[str, Any]) -> Any:
    """How gymnasium makes the task that was recorded; None where it does not know the task."""
    import gymnasium

    options = dict(metadata.get("env_options") or {})
    try:
        spec = gymnasium.spec(f"ccil/{metadata.get('task')}-v0")
    except gymnasium.error.Error:
        return None
    spec = copy.deepcopy(spec)  # not the one in the registry
    spec.max_episode_steps = options.pop("max_episode_steps", spec.max_episode_steps)
    spec.kwargs = {**spec.kwargs, **options}
    return spec


@contextlib.contextmanager
def _datasets_in(folder: str) -> Iterator[None]:
    """Has Minari keep its datasets in another folder for a while."""
    before = os.environ.get(_FOLDER_VARIABLE)
    os.environ[_FOLDER_VARIABLE] = folder
    try:
        yield
    finally:
        if before is None:
            del os.environ[_FOLDER_VARIABLE]
        else:
            os.environ[_FOLDER_VARIABLE] = before
