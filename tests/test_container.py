"""The Dockerfile, as far as that can be told without Docker."""

import fnmatch
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.test_documentation import ROOT

LINES = re.sub(r"\\\n\s*", "", (ROOT / "Dockerfile").read_text(encoding="utf-8")).splitlines()
STEPS = [(word, rest) for word, _, rest in (line.partition(" ") for line in LINES if line and line[0] != "#")]


def only(word: str) -> str:
    """What the one instruction of this kind says."""
    (rest,) = [rest for name, rest in STEPS if name == word]
    return rest


def environment() -> dict[str, str]:
    return dict(setting.split("=", 1) for setting in shlex.split(only("ENV")))


def is_sent(path: str) -> bool:
    """Whether .dockerignore lets the file into the image: the last line that matches decides."""
    sent = True
    for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").split():
        pattern = line.removeprefix("!").removeprefix("**/")
        parts = path.split("/") if "**" in line else [path.split("/")[0]]
        if any(fnmatch.fnmatch(part, pattern) for part in parts):
            sent = line.startswith("!")
    return sent


def tracked() -> list[str]:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    return listed.stdout.splitlines()


def test_the_image_gets_what_the_package_is_built_from_and_no_more() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    package = project["tool"]["hatch"]["build"]["targets"]["wheel"]["only-include"]
    wanted = {*package, "pyproject.toml", "hatch_build.py", project["project"]["readme"]}
    wanted |= {*project["project"]["license-files"]}
    assert {path.split("/")[0] for path in tracked() if is_sent(path)} == wanted
    assert is_sent("experiments/demonstrations/Swimmer.npz")
    assert not is_sent("envs/__pycache__/base.pyc")
    assert not is_sent(".git/config")


def test_only_the_volume_is_written_to_and_the_user_is_not_root() -> None:
    assert int(only("USER")) > 0
    assert only("WORKDIR") == only("VOLUME") == "/runs"
    places = {name: value for name, value in environment().items() if value.startswith("/") and name != "PATH"}
    assert places.keys() >= {"XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "MPLCONFIGDIR", "TMPDIR"}
    assert all(Path(value).is_relative_to("/runs") for value in places.values())
    assert json.loads(only("ENTRYPOINT")) == ["ccil"]


def test_its_python_is_one_that_the_package_is_tested_on() -> None:
    bases = {rest.split()[0] for word, rest in STEPS if word == "FROM"}
    assert bases == {"python:3.12-slim"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert "Programming Language :: Python :: 3.12" in project["classifiers"]


@pytest.mark.slow  # installs the package with all that it needs
def test_its_first_stage_installs_the_command_and_the_command_trains(tmp_path: Path) -> None:
    """The steps as a script, in folders of our own, with a home that cannot be written to."""
    source, runs = tmp_path / "source", tmp_path / "runs"
    for path in filter(is_sent, tracked()):
        (source / path).parent.mkdir(parents=True, exist_ok=True)
        (source / path).write_bytes((ROOT / path).read_bytes())
    runs.mkdir()
    places = {"/source": str(source), "/venv": str(tmp_path / "venv"), "/runs": str(runs)}

    def here(text: str) -> str:
        return re.sub(r"/source|/venv|/runs", lambda found: places[found[0]], text)

    install = next(rest for word, rest in STEPS if word == "RUN")
    python = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    subprocess.run(["bash", "-euc", here(install)], env=python, check=True, cwd=tmp_path)
    settings = {name: here(value) for name, value in environment().items()}
    settings |= {"PATH": f"{tmp_path}/venv/bin:{os.environ['PATH']}", "HOME": "/nonexistent"}
    given = "train --method malm --env Swimmer --preset tiny --num-seeds 1 --eval-episodes 2 --out first"
    subprocess.run([*json.loads(only("ENTRYPOINT")), *given.split()], env=settings, check=True, cwd=runs)
    assert (runs / "first" / "summary.json").is_file()
