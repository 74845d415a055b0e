"""Entry point of the command `ccil`, which works in every folder.

It is a module of its own beside the packages, with a name that nobody else uses: the current directory, which an empty
entry of PYTHONPATH puts before everything installed, may hold an `envs`, an `experiments` or a `ccil_jax` of its own.
"""

import importlib.machinery
import importlib.util
import sys
from pathlib import Path

PACKAGES = ("ccil_jax", "envs", "experiments")


def main() -> int:
    """Carries out the command line; returns the exit status."""
    load_packages(Path(__file__).parent)
    from experiments.cli import console

    return console.main()


def load_packages(folder: Path) -> None:
    """Imports our packages from `folder`; their modules are then found there, whatever else has their names."""
    specs = [importlib.machinery.PathFinder.find_spec(name, [str(folder)]) for name in PACKAGES]
    modules = [(spec, importlib.util.module_from_spec(spec)) for spec in specs if spec]
    sys.modules.update({spec.name: module for spec, module in modules})  # all, before one looks for another
    for spec, module in modules:
        if spec.loader:
            spec.loader.exec_module(module)
