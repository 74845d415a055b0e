"""The file `evaluation.json`: the newest evaluation in each simulator and, under `earlier`, all older ones.

{"ours": {"num_episodes": 50, "seed": 1, "deterministic": false, ..., "per_seed": [...]},
 "original": {...},
 "earlier": [{"simulator": "ours", "num_episodes": 50, "seed": 2, ...}]}
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ccil_jax.training import filesystem
from experiments.cli.command_line import UsageError
from experiments.runs import run_folder

SIMULATORS = ("ours", "original")
SETTINGS = ("run", "simulator", "num_episodes", "seed", "deterministic", "shared_episodes")
_EARLIER = "earlier"


def read(path: Path) -> dict[str, Any]:
    """The content of `path`, empty if there is no such file. Raises `UsageError` if it holds anything else."""
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"--out {path}: cannot be read ({error.strerror}); choose another file") from None
    except ValueError:
        content = None
    if not _holds_evaluations(content):
        raise UsageError(
            f"--out {path}: exists, and is not an intact file of evaluations; move it away or choose another name"
        )
    return dict(content)


def _holds_evaluations(content: Any) -> bool:
    if not isinstance(content, dict) or not set(content) <= {*SIMULATORS, _EARLIER}:
        return False
    earlier = content.get(_EARLIER, [])
    newest = [content[name] for name in SIMULATORS if name in content]
    return isinstance(earlier, list) and all(isinstance(e, dict) and "per_seed" in e for e in [*newest, *earlier])


def add(path: Path, evaluation: Mapping[str, Any]) -> None:
    """Adds `evaluation`, which has all keys of `SETTINGS`, to the file `path` and keeps the evaluations there.

    Only an evaluation with the same settings and the same results is replaced. Several processes may add to the file at
    the same time.
    """
    with filesystem.hold(path.with_name(f".{path.name}.lock"), wait=True):
        content = read(path)
        name = evaluation["simulator"]
        before = [{"simulator": name, **content[name]}] if name in content else []
        earlier = [e for e in [*content.pop(_EARLIER, []), *before] if not _is_repeated(e, evaluation)]
        more = {_EARLIER: earlier} if earlier else {}
        run_folder.write_json(path, {**content, name: evaluation, **more})


def _is_repeated(earlier: Mapping[str, Any], evaluation: Mapping[str, Any]) -> bool:
    settings = {"run": evaluation["run"], **earlier}  # older files do not name the run
    return all(settings.get(key) == evaluation[key] for key in (*SETTINGS, "per_seed"))
