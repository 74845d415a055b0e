"""What a result says about the program that made it: versions, and the commit of a checkout or an installation."""

import importlib.metadata
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest

import ccil_jax
from ccil_jax.training.versions import versions
from experiments.runs import provenance

COMMIT = "0123456789abcdef0123456789abcdef01234567"
HERE = Path(provenance.__file__).parents[2]


def install(monkeypatch: pytest.MonkeyPatch, folder: Path, direct_url: dict[str, Any] | None) -> None:
    """Sources in `folder`, not a checkout, which pip has recorded the origin of."""
    text = None if direct_url is None else json.dumps(direct_url)
    found = SimpleNamespace(locate_file=lambda name: folder / name, read_text=lambda name: text)
    monkeypatch.setattr(importlib.metadata, "distribution", lambda name: found)
    monkeypatch.setattr(provenance, "_checkout_commit", lambda: None)


@pytest.mark.parametrize(
    ("direct_url", "commit"),
    [
        ({"url": "https://x.invalid/y", "vcs_info": {"vcs": "git", "commit_id": COMMIT}}, COMMIT),
        ({"url": "file:///wheel", "archive_info": {}}, None),
        (None, None),
    ],
)
def test_an_installation_knows_the_commit_that_pip_built(
    direct_url: dict[str, Any] | None, commit: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, HERE, direct_url)
    assert provenance.git_commit() == commit


def test_a_wheel_says_which_commit_it_was_built_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, HERE, {"url": "file:///wheel", "archive_info": {}})
    (tmp_path / "ccil_jax").mkdir()
    (tmp_path / "ccil_jax" / "COMMIT").write_text(f"{COMMIT}-dirty\n")
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "experiments" / "runs" / "provenance.py"))
    assert provenance.git_commit() == f"{COMMIT}-dirty"


def test_the_commit_of_another_installation_is_not_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, tmp_path, {"vcs_info": {"commit_id": COMMIT}})
    assert provenance.git_commit() is None


def test_sources_that_nobody_installed_have_no_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> NoReturn:
        raise importlib.metadata.PackageNotFoundError(name)

    install(monkeypatch, HERE, None)
    monkeypatch.setattr(importlib.metadata, "distribution", missing)
    assert provenance.git_commit() is None


def test_versions_name_the_package_itself() -> None:
    assert versions()["ccil_jax"] == ccil_jax.__version__
    assert provenance.provenance().keys() == {"command", "versions", "git_commit"}
