"""The commands and the Python in the pages: each is understood by the launcher that it names, and some are run."""

import contextlib
import importlib
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from ccil_jax.errors import UserError
from ccil_jax.methods import METHODS, find_method
from envs.registry import TASKS
from experiments import ablations, sweep
from experiments.cli import console, options
from experiments.cli.names import safe_name
from experiments.page import film
from experiments.runs.environments import build_environment
from tests.probe_envs import quick_compilation
from tests.test_documentation import PAGES, ROOT

SHELL = ("", "sh", "bash", "console", "shell")  # of fenced blocks that hold commands
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"(?<!`)`([^`]+)`(?!`)")
LAUNCHED = re.compile(r"^(?:python -m )?experiments\.\w+ |^ccil \w|^make \w|^train --")
OUTPUT = "┃│"  # lines of a block that show what a command printed begin with one of these
PLACEHOLDERS = {  # words of the pages that a reader replaces, or whose file is not there yet
    "TASK": "Swimmer",
    "MY_TASK": "Swimmer",
    "METHOD": "malm",
    "STEPS": "300000",
    "N": "3",
    "S": "3",
    "J": "2",
    "P": "mjx",
    "minari:mujoco/hopper/expert-v0": "FILE",  # which the page downloads first
    "minari:cheetah/random-v0": "FILE",  # which the page records first
}
OTHERS = ("export", "mkdir", "minari", "tensorboard")  # programs that are not ours
PYTHON_IS_RUN = {
    "README.md": "below",
    "docs/commands.md": "test_policy_file.py",
    "docs/demonstrations.md": "test_exchange.py",
    "docs/extending.md": "test_extending.py",
}
WRONG = (AssertionError, ImportError, LookupError, SyntaxError, SystemExit, UserError)  # how a command may fail
TINY = ["--preset", "tiny", "--num-seeds", "1", "--eval-episodes", "2"]


class Command(NamedTuple):
    """One command of a page, as a reader would type it."""

    page: str
    words: tuple[str, ...]


def blocks(page: str, *languages: str) -> Iterator[str]:
    text = (ROOT / page).read_text(encoding="utf-8")
    yield from (content for language, content in FENCE.findall(text) if language in languages)


def words_of(line: str, replaced: Mapping[str, str] = PLACEHOLDERS) -> tuple[str, ...]:
    """Without comments, variables of the environment in front, where the output goes, and what a reader replaces."""
    words = shlex.split(line, comments=True)
    words = words[: words.index(">")] if ">" in words else words
    while words and re.match(r"[A-Z_]+=", words[0]):
        words = words[1:]
    return tuple(replaced.get(word, word) for word in words)


def commands(replaced: Mapping[str, str] = PLACEHOLDERS) -> Iterator[Command]:
    for page in PAGES:
        for block in blocks(page, *SHELL):
            for line in block.replace("\\\n", " ").splitlines():
                if line.strip() and line[0] not in OUTPUT and (words := words_of(line, replaced)):
                    yield Command(page, words)
        for span in INLINE.findall(FENCE.sub("", (ROOT / page).read_text(encoding="utf-8"))):
            span = " ".join(span.split())
            if LAUNCHED.match(span) and not span.endswith("NAME") and " | " not in span and "NAME ..." not in span:
                yield Command(page, words_of(span.removeprefix("python -m ").removesuffix(" ..."), replaced))


def check_launcher(name: str, given: list[str]) -> None:
    """Parses the options, and checks that they name what exists and that each of them makes a difference."""
    launcher = importlib.import_module(f"experiments.{name}")
    if given == ["--help"]:
        return
    arguments = vars(launcher.make_parser().parse_args(given))
    tasks = [arguments.get("env"), *arguments.get("tasks", [])]
    assert {task for task in tasks if task and ":" not in task} <= TASKS.keys()
    assert set(arguments.get("questions") or ()) <= ablations.QUESTIONS.keys()
    if name in ("train", "expert") and not arguments["resume"] and "env" in arguments:
        unconstrained = arguments.get("unconstrained", False)
        method = arguments.get("method", "trpo" if unconstrained else "expert")
        assert method in METHODS or ":" in method
        if ":" not in method:
            limit = {} if name == "train" or unconstrained else {"cost_limit": 1.0}
            preset = arguments.get("preset", find_method(method).preset if name == "train" else "expert")
            options.config_from({**limit, **arguments, "method": method}, preset)


def check(words: tuple[str, ...]) -> None:
    """Raises or exits where the command could not be carried out as it stands."""
    first, *rest = words
    if first.startswith("experiments."):
        check_launcher(first.removeprefix("experiments."), rest)
    elif first == "ccil":
        check(("experiments." + rest[0], *rest[1:])) if not rest[0].startswith("-") else None
    elif first == "train":  # in a sentence about it
        check_launcher("train", rest)
    elif first.endswith("python") or first.startswith("python3"):
        check_python(rest)
    elif first == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        assert {word for word in rest if "=" not in word} <= set(targets)
    elif first.endswith("pip"):
        check_extras(rest)
    elif first == "docker":
        if rest[0] == "run":
            check(("ccil", *rest[rest.index("ccil_jax") + 1 :]))
    elif first == "bash":
        assert (ROOT / rest[0]).is_file()
    else:
        assert first in OTHERS, "what kind of command is this?"


def check_python(rest: list[str]) -> None:
    if rest[:1] == ["-m"]:
        module, *given = rest[1:]
        if module.startswith("experiments."):
            check((module, *given))
        else:
            assert module in ("venv", "pip") or (ROOT / (module.replace(".", "/") + ".py")).is_file()
    elif rest[:1] == ["-c"]:
        compile(rest[1], "page", "exec")
    else:
        assert (ROOT / rest[0]).is_file()


def check_extras(rest: list[str]) -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    named = [extra for word in rest for extra in re.findall(r"^ccil_jax\[(.*)\]$", word)]
    assert {extra for names in named for extra in names.split(",")} <= known.keys()


@pytest.mark.parametrize("page", PAGES)
def test_every_command_of_a_page_is_understood(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    for command in commands():
        if command.page == page:
            try:
                check(command.words)
            except WRONG as error:
                pytest.fail(f"{shlex.join(command.words)}: {error} {capsys.readouterr().err}")


@pytest.mark.parametrize(
    "line",
    [
        "experiments.train --method malm --env Swimer",
        "experiments.train --method malmm --env Swimmer",
        "experiments.train --method malm --env Swimmer --preset papre",
        "experiments.train --method bc --env Swimmer --max-kl 1",  # without effect
        "experiments.expert --env Swimmer --outt x.npz",
        "experiments.ablations --env Swimmer --out x --questions nobody",
        "experiments.trian --method malm",
        "python -m tests.nowhere",
        "make coffee",
        "pip install 'ccil_jax[wrap]'",
        "docker run ccil_jax train --metod malm",
        "conda install x",
    ],
)
def test_a_wrong_command_would_be_found(line: str) -> None:
    with pytest.raises(WRONG):
        check(words_of(line))


def test_the_pages_show_every_launcher() -> None:
    """In a block of commands; `tests/` runs each of them elsewhere with small settings."""
    lines = [shlex.join(command.words) for command in commands()]
    for name in console.launchers():
        assert any(f"experiments.{name}" in line or line.startswith(f"ccil {name} ") for line in lines), name
    assert len(lines) > 80


def test_the_python_of_every_page_is_run_by_a_test() -> None:
    assert {page for page in PAGES if [*blocks(page, "python")]} == PYTHON_IS_RUN.keys()


def test_the_python_of_the_readme_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (block,) = blocks("README.md", "python")
    for long, short in (('"default"', '"tiny"'), ("result.actor, env)", "result.actor, env, num_episodes=2)")):
        assert long in block
        block = block.replace(long, short)
    monkeypatch.chdir(ROOT)
    namespace: dict[str, Any] = {}
    with quick_compilation():
        exec(compile(block, "README.md", "exec"), namespace)  # noqa: S102  (the page is ours)
    assert np.shape(namespace["found"].episode_cost) == (2, 2)
    assert str(namespace["found"].episode_return) in capsys.readouterr().out


def test_the_sweep_of_the_page_is_two_programs_of_six_runs(tmp_path: Path) -> None:
    from experiments.sweeps import variants

    (block,) = blocks("docs/sweeps.md", "toml")
    spec = tmp_path / "spec.toml"
    spec.write_text(block, encoding="utf-8")
    found = sweep.variants_of(spec, sweep.read_spec(spec), tmp_path / "out")
    jobs = variants.group([variant for variant, _ in found.values()], tmp_path / "out")
    assert [sum(v.plan.setup.num_seeds for v in job.variants) for job in jobs] == [6, 6]
    assert safe_name("multiplier_learning_rate=0.1,hidden_sizes=64,64") in found


@pytest.fixture
def own_tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with `my_tasks.py`, as docs/extending.md describes it: its first block and the slow cheetah."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    cart, *others = blocks("docs/extending.md", "python")
    (cheetah,) = (block for block in others if "def slow_cheetah" in block)
    (tmp_path / "my_tasks.py").write_text(cart.partition("envs.register")[0] + cheetah, encoding="utf-8")
    with contextlib.ExitStack() as stack:
        stack.callback(sys.modules.pop, "my_tasks", None)
        stack.enter_context(quick_compilation())
        yield tmp_path


def test_a_task_under_another_cost_is_built_as_the_launchers_do_it(own_tasks: Path) -> None:
    """With the options of its function, and drawn as the task that it is made of."""
    env = build_environment("my_tasks:slow_cheetah", "native", {"max_episode_steps": 30})
    assert (env.name, env.max_episode_steps, film.obstacle(env)) == ("HalfCheetah", 30, "")
