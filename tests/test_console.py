"""The command `ccil`, the packages that it and `python -m` find, and the command that is recorded."""

import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

import ccil_jax
from experiments.cli import command_line, console

ROOT = Path(__file__).parent.parent
SCRIPT = f"""#!{sys.executable}
import sys
sys.path.append({str(ROOT)!r})
from ccil_command import main
try:
    status = main()
finally:
    print("JAX" if "jax" in sys.modules else "no JAX")
"""


def python(*arguments: str | Path, cwd: Path, path: str = str(ROOT)) -> subprocess.CompletedProcess[str]:
    settings = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, env=settings, capture_output=True, text=True, timeout=60, check=False)


def packages(folder: Path, names: Sequence[str]) -> None:
    """Packages of somebody else, which happen to have our names."""
    for name in names:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text("raise RuntimeError('somebody else is imported')\n")


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """What an installation writes: a script `ccil` in a folder of its own."""
    path = tmp_path / "bin" / "ccil"
    path.parent.mkdir()
    path.write_text(SCRIPT)
    return path


def test_the_overview_lists_every_launcher(capsys: pytest.CaptureFixture[str]) -> None:
    known = "ablations benchmark completion convert evaluate expert growth replay_fault report sweep theorem1 train"
    assert [*console.launchers()] == known.split()
    for arguments in ([], ["--help"], ["-h"]):
        assert console.main(arguments) == 0
        shown = capsys.readouterr().out
        assert "usage: ccil NAME [options]" in shown
        assert "  train         Trains one method on one task, all seeds in one program, " in shown


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert console.main(["--version"]) == 0
    assert capsys.readouterr().out == f"ccil_jax {ccil_jax.__version__}\n"


@pytest.mark.parametrize(
    ("name", "hint"),
    [("trian", "did you mean train?"), ("replay-falt", "did you mean replay_fault?"), ("x\x1b", "see")],
)
def test_an_unknown_launcher_gets_the_nearest_name(name: str, hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert console.main([name]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"ccil: error: {name}: unknown; {hint}".replace("\x1b", "?"))
    assert error.count("\n") == 1


def test_hyphens_are_as_good_as_underscores(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        console.main(["replay-fault", "--help"])
    assert end.value.code == 0
    assert "replay_fault [options]" in capsys.readouterr().out


def test_the_command_works_beside_packages_of_the_same_names(script: Path, tmp_path: Path) -> None:
    """An empty entry of PYTHONPATH is the current directory, and stands before everything installed."""
    packages(tmp_path, ["envs", "experiments", "ccil_jax"])
    done = python(script, "train", "--env", "Swimmer", cwd=tmp_path, path=os.pathsep)
    assert done.stderr.startswith("ccil train: error: --method: required; one of malm")
    assert done.stderr.count("\n") == 1
    assert done.stdout == "no JAX\n"


@pytest.mark.parametrize(
    ("foreign", "statement"),
    [("envs", "import ccil_jax"), ("envs", "import experiments.train"), ("ccil_jax", "import experiments.train")],
)
def test_a_foreign_package_is_named(foreign: str, statement: str, tmp_path: Path) -> None:
    packages(tmp_path, [foreign])
    done = python("-c", statement, cwd=tmp_path)
    assert done.returncode == 1
    error = done.stderr.splitlines()[-1]
    assert error.startswith("ImportError: ")
    assert str(tmp_path / foreign) in error
    assert str(ROOT / foreign) in error
    assert "`ccil`" in error


def test_folders_that_are_no_packages_do_not_matter(tmp_path: Path) -> None:
    """Nor does a project's own `experiments`, which the library does not need, nor that ours is reached by a link."""
    (tmp_path / "envs").mkdir()
    packages(tmp_path, ["experiments"])
    (tmp_path / "link").symlink_to(ROOT)
    done = python("-c", "import ccil_jax, envs; print(ccil_jax.Config().method)", cwd=tmp_path, path="link")
    assert (done.returncode, done.stdout) == (0, "malm\n"), done.stderr


AWKWARD = ["--out", "my runs/it's $HOME", '"', "*", "a\\b", ""]


def test_a_recorded_command_repeats_itself_in_a_shell(tmp_path: Path) -> None:
    code = "import sys; from experiments.cli.command_line import command; print(sys.argv[1:]); print(command())"
    first = python("-c", code, *AWKWARD, cwd=tmp_path)
    given, command = first.stdout.splitlines()
    assert given == str(AWKWARD)
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    again = subprocess.run(["sh", "-c", command], env=settings, capture_output=True, text=True, check=True)
    assert again.stdout == first.stdout


@pytest.mark.parametrize(
    ("module", "program", "started"),
    [
        ("experiments.train", f"{ROOT}/experiments/train.py", ["python", "-m", "experiments.train"]),
        (None, f"{Path(sys.executable).parent}/ccil", ["ccil"]),
    ],
)
def test_the_recorded_command_is_what_was_typed(
    module: str | None, program: str, started: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = module and type("Spec", (), {"name": module})
    monkeypatch.setitem(sys.modules, "__main__", type("Main", (), {"__spec__": spec}))
    monkeypatch.setattr(sys, "argv", [program, *AWKWARD])
    assert shlex.split(command_line.command()) == [*started, *AWKWARD]
    assert command_line.Parser("train", "").prog == ("ccil train" if module is None else "python -m experiments.train")
