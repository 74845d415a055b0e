"""Prints a script with which a shell completes the command `ccil`: launchers, options, tasks, methods, presets, files.

For bash:  ccil completion bash > ~/.local/share/bash-completion/completions/ccil
For zsh:   ccil completion zsh > ~/.zfunc/_ccil      (with `fpath+=~/.zfunc` before `compinit` in ~/.zshrc)
For fish:  ccil completion fish > ~/.config/fish/completions/ccil.fish

It takes effect in the next shell. Print it again after an update.
"""

import argparse
import importlib
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import shtab

from ccil_jax.config import CHOICES
from ccil_jax.methods import METHODS
from envs.registry import TASKS
from experiments.cli import command_line, console
from experiments.cli.command_line import CONSOLE, Parser, boolean
from experiments.runs import demonstration_files

SHELLS = ("bash", "zsh", "fish")  # of those that shtab knows, the ones in which completion has been tried


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("completion", __doc__ or "")
    parser.add_argument("shell", choices=SHELLS, help="the shell that shall complete")
    return parser


def script(shell: str) -> str:
    """The script for one of `SHELLS`."""
    root = argparse.ArgumentParser(CONSOLE)
    root.add_argument("--version", action="store_true", help="the version of the package")
    commands = root.add_subparsers()
    for name, line in console.launchers().items():
        launcher: Parser = importlib.import_module(f"experiments.{name}").make_parser()
        for action in launcher.actions:
            _suggest(action)
        commands.add_parser(name, help=line, description=line, parents=[launcher], add_help=False)
    return shtab.complete(root, shell)


def _suggest(action: argparse.Action) -> None:
    """Adds what to suggest to an option that accepts more than fixed choices. The parser is for completion alone."""
    names: Iterable[str] | None = CHOICES.get(action.dest)
    if action.metavar == "TASK":
        names = TASKS
    elif action.dest == "method":
        names = METHODS
    elif action.type is boolean:
        names = ("true", "false")
    elif action.type in (Path, demonstration_files.to_read):
        action.complete = shtab.FILE  # type: ignore[attr-defined]  # where shtab looks for it
    action.choices = action.choices or names


def run(arguments: argparse.Namespace) -> None:
    """Prints the script."""
    print(script(arguments.shell))


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
