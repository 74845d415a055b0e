"""Completion in shells: bash itself is asked what it would offer."""

import subprocess
import sys
from pathlib import Path

import pytest

from ccil_jax.config import CHOICES
from ccil_jax.methods import METHODS
from ccil_jax.presets import PRESETS
from envs.registry import TASKS
from experiments import completion
from experiments.cli import console


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "ccil"
    path.write_text(completion.script("bash"))
    return path


def offered(script: Path, *words: str) -> list[str]:
    """What bash offers in the place of the last word of a command line."""
    code = f'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD={len(words)}; '
    code += '$(complete -p ccil | sed "s/.*-F \\([^ ]*\\) .*/\\1/"); printf "%s\\n" "${COMPREPLY[@]}"'
    command = ["bash", "--noprofile", "--norc", "-c", code, "bash", str(script), "ccil", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=script.parent)
    assert done.stderr == ""
    return [line for line in done.stdout.split("\n") if line]


def test_bash_completes_launchers_options_and_their_values(script: Path) -> None:
    tasks = [task.name for task in TASKS.values() if task.original_package]  # other tests register tasks of their own
    assert offered(script, "train", "--env", "Ho") == ["Hopper"]
    assert set(offered(script, "expert", "--env", "")) >= set(tasks)
    assert offered(script, "tr") == ["train"]
    assert set(offered(script, "")) == {*console.launchers()}
    assert set(offered(script, "train", "--env", "Hopper", "--method", "")) >= {"malm", "bc"}
    assert set(offered(script, "train", "--method", "")) == {*METHODS}
    assert set(offered(script, "train", "--preset", "")) == {*PRESETS}
    assert offered(script, "train", "--discriminator-reg") == ["--discriminator-regularizer"]
    assert set(offered(script, "train", "--discriminator-regularizer", "")) == {*CHOICES["discriminator_regularizer"]}
    assert offered(script, "train", "--one-by-one", "t") == ["true"]
    assert offered(script, "evaluate", "runs", "--simulator", "o") == ["ours", "original"]
    assert offered(script, "benchmark", "--tasks", "Swimmer", "Ho") == ["Hopper"]


def test_bash_completes_files(script: Path) -> None:
    (script.parent / "expert.npz").write_text("")
    assert offered(script, "train", "--demos", "exp") == ["expert.npz"]
    assert offered(script, "convert", "exp") == ["expert.npz"]


def test_every_shell_gets_a_script_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert {*completion.SHELLS} == {"bash", "zsh", "fish"}
    for shell, start in (("bash", "complete "), ("zsh", "#compdef ccil"), ("fish", "complete ")):
        assert completion.main([shell]) == 0
        shown = capsys.readouterr().out
        assert start in shown
        assert "Hopper" in shown
        assert "discriminator-regularizer" in shown
    with pytest.raises(SystemExit) as end:
        completion.main(["ksh"])
    assert end.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_nothing_heavy_is_needed_to_print_it() -> None:
    code = "import sys; from experiments.completion import script; script('bash'); print('jax' in sys.modules)"
    root = Path(__file__).parent.parent
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
