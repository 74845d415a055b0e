"""What all tests share: the CPU, reproducible examples, and signatures that are checked while the tests run."""

import functools
import importlib.abc
import importlib.machinery
import inspect
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType

import beartype
import jaxtyping
import pytest
from hypothesis import settings

from experiments.cli import xla

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ccil_jax" / "tests"
ENVIRONMENT = {  # read when the packages are imported, here and in the tests' subprocesses
    "JAX_PLATFORMS": "cpu",
    "MPLBACKEND": "agg",
    # What is slow to compile is compiled once for all test processes and later runs. A limit of the size makes JAX
    # lock the folder: without one, a process can read what another has half written.
    "JAX_COMPILATION_CACHE_DIR": str(CACHE),
    "JAX_COMPILATION_CACHE_MAX_SIZE": str(2**30),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
}
assert "jax" not in sys.modules, "imported too early to be set"
for variable, value in ENVIRONMENT.items():
    os.environ.setdefault(variable, value)
xla.widen_vectors()  # as in launchers, whose results some tests compare with those of this process

# The first call of a jitted function compiles, so no example has a deadline. The same examples on every run.
settings.register_profile("tests", deadline=None, derandomize=True)
settings.load_profile("tests")

CHECKED = (  # modules of functions on arrays; shapes must agree across the arguments and the result of each call
    "ccil_jax.learning.constraints",
    "ccil_jax.acting.distributions",
    "ccil_jax.learning.regression",
    "ccil_jax.learning.returns",
    "ccil_jax.acting.running_statistics",
    "ccil_jax.learning.trust_region",
)
# An int passes for a float, as it does for mypy.
TYPECHECKER = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))


def check_signatures(module: ModuleType) -> None:
    """Wraps the functions that `module` defines so that every call is checked against its annotations.

    jaxtyping's own import hook would check classes too, and tree transformations rebuild containers with leaves that
    are no arrays (`flax.struct` fields): here classes are left alone.
    """
    for name, value in vars(module).copy().items():
        if inspect.isfunction(value) and value.__module__ == module.__name__:
            setattr(module, name, jaxtyping.jaxtyped(typechecker=TYPECHECKER)(value))


class CheckingFinder(importlib.abc.MetaPathFinder):
    """Checks the modules in `CHECKED` from the moment of their import, before anyone can take a name from them."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name not in CHECKED:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        @functools.wraps(execute)
        def execute_and_check(module: ModuleType) -> None:
            execute(module)
            check_signatures(module)

        spec.loader.exec_module = execute_and_check  # type: ignore[method-assign]
        return spec


assert not set(CHECKED) & set(sys.modules), "imported too early to be checked"
sys.meta_path.insert(0, CheckingFinder())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files come in the reverse order of their names.

    The tests of a file run in one process, and short files come first by name: with these at the end, no process works
    alone for long.
    """
    items.sort(key=lambda item: item.path.name, reverse=True)


@pytest.fixture(scope="session", autouse=True)
def outside_the_checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests run where nothing of the checkout is near and stray files, such as MuJoCo's log, do no harm."""
    checkout = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("elsewhere"))
    yield
    os.chdir(checkout)
