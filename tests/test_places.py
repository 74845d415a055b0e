"""Where launchers put things: the folder of a run, the cache of programs, and nothing where there is no place."""

import os
import pwd
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NoReturn

import pytest

from experiments import convert, expert, train
from experiments.cli import command_line, xla
from experiments.cli.command_line import UsageError

SHIPPED = Path(convert.__file__).parent / "demonstrations" / "Swimmer.npz"


@pytest.fixture
def homeless(monkeypatch: pytest.MonkeyPatch) -> None:
    """A numeric user whom the system does not know, without HOME: containers and batch systems start such processes."""

    def unknown(_: object) -> NoReturn:
        raise KeyError("uid not found")

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    for name in ("HOME", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RuntimeError):
        Path.home()


@pytest.mark.usefixtures("homeless")
def test_launchers_work_without_a_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "demonstrations.npz"
    assert convert.main([str(SHIPPED), "--env", "Swimmer", "--out", str(out)]) == 0
    assert out.is_file()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "own"))
    xla.keep_programs()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "own")


@pytest.mark.usefixtures("homeless")
def test_programs_are_kept_where_a_cache_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    xla.keep_programs()
    assert Path(os.environ["JAX_COMPILATION_CACHE_DIR"]).parent == tmp_path / "ccil_jax" / "programs"


def test_runs_that_begin_in_the_same_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: command_line.default_folder("Swimmer", "malm"), range(24)))
    assert len(set(folders)) == 24
    assert all((tmp_path / folder).is_dir() for folder in folders)
    assert all(folder.name.startswith("Swimmer_malm_2") for folder in folders)
    assert max(len(folder.name) for folder in folders) == len("Swimmer_malm_20260101-120000-02")
    for folder in folders:
        command_line.check_output_folder(folder)


def test_a_folder_that_cannot_be_made_is_wrong_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs").write_text("a file")
    with pytest.raises(UsageError, match=r"--run-dir runs/Swimmer_expert_\S+: cannot be written \(File exists\)"):
        command_line.default_folder("Swimmer", "expert", "--run-dir")


def test_a_run_that_is_refused_leaves_no_folder_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints cannot be kept below a folder with [ in its name."""
    folder = tmp_path / "lr[0.1]"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for launcher, given in (
        (train, ["--method", "bc"]),
        (expert, ["--out", str(tmp_path / "expert.npz")]),
    ):
        with pytest.raises(SystemExit):
            launcher.main(["--env", "Swimmer", *given])
        assert list(folder.iterdir()) == []
