"""What made a result: the command line, the versions of the packages, and the git commit of the sources."""

import importlib.metadata
import json
import subprocess
from pathlib import Path
from typing import Any

from ccil_jax.training.versions import versions
from experiments.cli.command_line import command


def provenance() -> dict[str, Any]:
    """The command line of this process, the versions and the commit, by their names in result files."""
    return {"command": command(), "versions": versions(), "git_commit": git_commit()}


def git_commit() -> str | None:
    """The commit of the sources, with `-dirty` after it where tracked files were changed; None if it is not known."""
    return _checkout_commit() or _built_commit() or _installed_commit()


def _checkout_commit() -> str | None:
    """The commit of the git checkout that this file is in; None where it is in none, or in that of other sources.

    `hatch_build.commit_of` is its twin: it asks git the same when a wheel is built, and cannot import this package.
    """
    try:
        if _git("rev-parse", "--show-prefix") != "experiments/runs/":  # the folder of this file, from the top
            return None  # installed inside the checkout of another project
        head = _git("rev-parse", "HEAD")
        changed = _git("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("-dirty" if changed else "")


def _built_commit() -> str | None:
    """The commit that the wheel of this installation was built from, as `hatch_build.py` wrote it down."""
    try:
        return (Path(__file__).parents[2] / "ccil_jax" / "COMMIT").read_text(encoding="utf-8").strip() or None
    except OSError:
        return None


def _installed_commit() -> str | None:
    """The commit that `pip install git+URL` built this installation from (PEP 610); None for any other."""
    try:
        installed = importlib.metadata.distribution("ccil_jax")
    except importlib.metadata.PackageNotFoundError:
        return None
    if Path(str(installed.locate_file("experiments"))).resolve() != Path(__file__).resolve().parents[1]:
        return None  # these sources are others than the installed ones
    origin = json.loads(installed.read_text("direct_url.json") or "{}")
    commit = origin.get("vcs_info", {}).get("commit_id")
    return str(commit) if commit else None


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    folder = Path(__file__).parent
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
