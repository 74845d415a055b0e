"""Puts the commit that a wheel is built from into it, as the file `ccil_jax/COMMIT`.

Results then name the sources that made them, also where the package was installed from a wheel. hatchling finds this
file by its name.
"""

import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CommitHook(BuildHookInterface):  # type: ignore[type-arg]
    """Nothing is written where the sources are no checkout, as in a source distribution."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called before the wheel is built; `version` is "editable" for an installation that stays in the checkout."""
        commit = None if version == "editable" else commit_of(Path(self.root))
        if commit:
            path = self._file()
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{commit}\n", encoding="utf-8")
            build_data["force_include"][str(path)] = "ccil_jax/COMMIT"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Called when the wheel is there."""
        self._file().unlink(missing_ok=True)

    def _file(self) -> Path:
        return Path(self.directory) / ".commit"


def commit_of(root: Path) -> str | None:
    """The commit of the checkout `root`, with `-dirty` after it where files differ; None if it is no checkout.

    `experiments.runs.provenance._checkout_commit` is its twin: the build cannot import the package that it builds.
    """

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, timeout=10, check=True)
        return done.stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != root.resolve():
            return None
        return git("rev-parse", "HEAD") + ("-dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None
