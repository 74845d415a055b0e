"""Rules that a reader of one file cannot see: who may import whom, what importing costs, what is never called."""

import ast
import graphlib
import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("ccil_jax", "envs", "experiments")
SOURCES = {  # module name -> file
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}
FOREIGN = {
    name for name in SOURCES if name.startswith("experiments.speed.peers.")
}  # they run in environments of their own
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in SOURCES.items()}

# What each package is made of, the ground first. A file imports only from its own folder and from those before it.
WINGS = {
    "ccil_jax": ("", "demonstrations", "acting", "learning", "agents", "training"),
    "experiments": ("cli", "runs", "policies", "page", "speed", "sweeps", "theory", ""),
}
# All that the learner knows of the tasks.
GROUND = ("envs.base", "envs.jax_tools", "envs.lookup")
# The step takes gradients and weights, whatever they stand for; the constraints get the inner step as a function.
STRANGERS = {
    "ccil_jax.learning.trust_region": {"config", "trajectories", "networks", "reward_models", "rollout"},
    "ccil_jax.learning.constraints": {"trust_region", "rollout", "reward_models", "networks"},
}
FORBIDDEN_CALLS = {  # each runs code that it finds in data
    "eval", "exec", "compile", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "marshal.load", "marshal.loads",
    "shelve.open", "pandas.read_pickle", "torch.load",
}  # fmt: skip
FORBIDDEN_MODULES = {"pickle", "cloudpickle", "dill", "joblib", "jsonpickle", "marshal", "shelve"}
DEVICE_WORK = (
    "jax.numpy.",
    "jax.random.",
    "jax.lax.",
    "jax.nn.",
    "jax.device",
    "jax.local_device",
    "jax.default_backend",
)


def imports(tree: ast.AST) -> Iterator[str]:
    """Names of the modules and members that a file imports, wherever it does so."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in line {node.lineno}"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def module_of(name: str) -> str:
    """The source module in which an imported name lives; the name itself if it is not one of ours."""
    while name not in SOURCES and "." in name:
        name = name.rpartition(".")[0]
    return name


def own_imports(name: str) -> set[str]:
    constants = {"ccil_jax.__version__"}  # of a package whose other names stand for modules
    found = {module_of(imported) for imported in imports(TREES[name]) if imported not in constants}
    return {module for module in found if module.partition(".")[0] in (*PACKAGES, "tests")}


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    """Every call of a plain dotted name, with aliases of imports resolved."""
    aliases: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            aliases |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom):
            aliases |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            root, dot, rest = ast.unparse(node.func).partition(".")
            yield aliases.get(root, root) + dot + rest, node


def test_the_sources_are_found() -> None:
    assert {"ccil_jax", "ccil_jax.training.runner", "envs.base", "envs.registry", "experiments.train"} <= SOURCES.keys()


@pytest.mark.parametrize("name", SOURCES)
def test_packages_import_only_downwards(name: str) -> None:
    package = name.partition(".")[0]
    allowed = {
        "envs": lambda module: module.startswith("envs"),
        "ccil_jax": lambda module: module.startswith("ccil_jax") or module in GROUND,
        "experiments": lambda module: not module.startswith("tests"),
    }[package]
    assert [module for module in own_imports(name) if not allowed(module)] == []


def wing_of(name: str) -> str:
    """The folder of its package that a module is in; "" for a file beside the folders."""
    parts = name.split(".")
    return parts[1] if len(parts) > 2 or (len(parts) == 2 and SOURCES[name].name == "__init__.py") else ""


@pytest.mark.parametrize("name", [name for name in SOURCES if name.partition(".")[0] in WINGS and "." in name])
def test_files_import_only_from_folders_before_theirs(name: str) -> None:
    package = name.partition(".")[0]
    order = WINGS[package]
    allowed = order[: order.index(wing_of(name)) + 1]
    imported = [module for module in own_imports(name) if module.startswith(f"{package}.")]
    assert [module for module in imported if wing_of(module) not in allowed] == []


@pytest.mark.parametrize("name", STRANGERS)
def test_strangers_do_not_know_each_other(name: str) -> None:
    assert not {module.rpartition(".")[2] for module in own_imports(name)} & STRANGERS[name]


@pytest.mark.parametrize("package", WINGS)
def test_the_folders_named_are_there(package: str) -> None:
    assert sorted(WINGS[package]) == sorted({wing_of(name) for name in SOURCES if name.startswith(f"{package}.")})


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Wherever in a file the import stands."""
    graph = {name: own_imports(name) - {name, *PACKAGES} for name in SOURCES}
    list(graphlib.TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("name", SOURCES)
def test_no_file_can_make_us_run_its_code(name: str) -> None:
    allowed = (
        {"pickle"} if name == "ccil_jax.demonstrations.pickled_npz" else set()
    )  # the restricted reader: see the next test
    assert [m for m in imports(TREES[name]) if m.partition(".")[0] in FORBIDDEN_MODULES - allowed] == []
    for function, call in calls(TREES[name]):
        where = f"{name}, line {call.lineno}: {function}"
        assert function not in FORBIDDEN_CALLS, where
        for keyword in call.keywords:
            if keyword.arg == "allow_pickle":
                assert isinstance(keyword.value, ast.Constant), where
                assert keyword.value.value is False, where


def test_the_restricted_reader_takes_only_the_class_from_pickle() -> None:
    tree = TREES["ccil_jax.demonstrations.pickled_npz"]
    used = {
        ast.unparse(n) for n in ast.walk(tree) if isinstance(n, ast.Attribute) and ast.unparse(n).startswith("pickle.")
    }
    assert used == {"pickle.Unpickler", "pickle.UnpicklingError"}
    assert [m for m in imports(tree) if m.startswith("pickle.")] == []
    assert any(isinstance(n, ast.FunctionDef) and n.name == "find_class" for n in ast.walk(tree))
    assert "super().find_class" not in ast.unparse(tree)


def at_import(tree: ast.Module) -> Iterator[ast.AST]:
    """The parts of a module that run when it is imported: all but the bodies of its functions."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            waiting += [*node.decorator_list, *node.args.defaults, *filter(None, node.args.kw_defaults)]
        elif isinstance(node, ast.Lambda):
            waiting += [*node.args.defaults, *filter(None, node.args.kw_defaults)]
        else:
            yield node
            waiting += ast.iter_child_nodes(node)


@pytest.mark.parametrize("name", SOURCES)
def test_importing_does_no_work_on_a_device(name: str) -> None:
    tree = TREES[name]
    run = {id(node) for node in at_import(tree)}
    found = [(f, call.lineno) for f, call in calls(tree) if id(call) in run and f.startswith(DEVICE_WORK)]
    assert found == []


def python(code: str, **environment: str) -> str:
    """Runs code in a fresh interpreter; returns what it prints."""
    command, settings = [sys.executable, "-c", code], {**os.environ, **environment}
    result = subprocess.run(command, cwd=ROOT, env=settings, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.parametrize("name", ["ccil_jax", "envs", "experiments", "ccil_jax.config", "envs.registry"])
def test_importing_imports_no_heavy_package(name: str) -> None:
    heavy = ("jax", "jaxlib", "flax", "optax", "orbax", "chex", "brax", "mujoco", "matplotlib", "gymnasium")
    assert python(f"import sys, {name}; print([m for m in {heavy} if m in sys.modules])").strip() == "[]"


def test_only_those_who_ask_for_it_pay_for_brax() -> None:
    """Brax brings a web server along."""
    modules = sorted(SOURCES.keys() - FOREIGN - {"envs.physics.warp_patch"})
    found = python(
        "import importlib, sys, envs\n"
        f"for name in {modules}: importlib.import_module(name)\n"
        "envs.make('Swimmer', physics='native'), envs.make('Swimmer', physics='mjx')\n"
        "print([name for name in ('brax', 'flask') if name in sys.modules])"
    )
    assert found.splitlines()[-1] == "[]"


def test_everything_can_be_imported_where_jax_has_no_device() -> None:
    python(
        "import importlib, ccil_jax, envs\n"
        f"for name in {sorted(SOURCES.keys() - FOREIGN)}: importlib.import_module(name)\n"
        "for package in (ccil_jax, envs):\n"
        "    for name in package.__all__: getattr(package, name)",
        JAX_PLATFORMS="no_such_platform",
    )


@pytest.mark.parametrize("name", [name for name in SOURCES if not name.startswith("experiments")])
def test_public_names_have_docstrings(name: str) -> None:
    assert ast.get_docstring(TREES[name]), "the module itself"
    missing = [node.name for node in public(TREES[name]) if not ast.get_docstring(node)]
    assert missing == []


def public(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    """Public functions, classes and methods, except those of protocols: their class speaks for them."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node
            is_protocol = isinstance(node, ast.ClassDef) and "Protocol" in map(ast.unparse, node.bases)
            if isinstance(node, ast.ClassDef) and not is_protocol:
                methods = (member for member in node.body if isinstance(member, ast.FunctionDef))
                yield from (method for method in methods if not method.name.startswith("_"))


def test_no_file_names_a_folder_of_one_machine() -> None:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listing.returncode:
        pytest.skip("not a git checkout")
    pattern = re.compile(r"(?<![\w./~-])/(?:home|root|Users|work|tmp|opt|mnt|scratch)/\w|[A-Z]:\\\\")
    for file in filter(None, listing.stdout.split("\0")):
        path = ROOT / file
        content = path.read_bytes() if path.is_file() else b""
        if b"\0" not in content:
            lines = content.decode().splitlines()
            assert [(file, number) for number, line in enumerate(lines, 1) if pattern.search(line)] == []


def test_the_version_is_that_of_the_package() -> None:
    import ccil_jax

    if "ccil_jax" not in {distribution.metadata["Name"] for distribution in importlib.metadata.distributions()}:
        pytest.skip("not installed")
    assert ccil_jax.__version__ == importlib.metadata.version("ccil_jax")


def test_one_place_says_the_version() -> None:
    """The build reads it from the package."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" not in settings["project"]
    assert settings["project"]["dynamic"] == ["version"]
    place = ROOT / settings["tool"]["hatch"]["version"]["path"]
    assert place == SOURCES["ccil_jax"]
    assert len(re.findall(r'^__version__ = "\d+\.\d+\.\d+"$', place.read_text(encoding="utf-8"), re.MULTILINE)) == 1


def test_editors_know_the_public_names_that_are_imported_lazily() -> None:
    """What a type checker sees of `ccil_jax` is what is there at run time."""
    import ccil_jax

    conditions = (node for node in TREES["ccil_jax"].body if isinstance(node, ast.If))
    (block,) = (node for node in conditions if ast.unparse(node.test) == "TYPE_CHECKING")
    seen = {
        alias.asname: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert seen == ccil_jax._HOMES


def test_the_documentation_draws_the_folders_in_the_order_of_their_imports() -> None:
    """From top to bottom; the ground, which others import from, stands last."""
    drawing = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("```")[1]
    for package, wings in WINGS.items():
        section = re.search(rf"^{package}/.*?(?=^\S|\Z)", drawing, re.MULTILINE | re.DOTALL)
        assert section
        drawn = re.findall(r"^  (\w+)/", section[0], re.MULTILINE)
        assert drawn == [wing for wing in reversed(wings) if wing]
    launchers = drawing.partition("Wrong input")[0].partition("one file each:")[2].replace(".", "").split()
    assert sorted(launchers) == sorted(
        name.removeprefix("experiments.") for name in SOURCES if name.startswith("experiments.") and not wing_of(name)
    )


@pytest.mark.parametrize("name", SOURCES)
def test_no_function_has_more_than_sixty_lines(name: str) -> None:
    """Its docstring aside."""
    functions = [node for node in ast.walk(TREES[name]) if isinstance(node, ast.FunctionDef)]
    assert [node.name for node in functions if length(node) > 60] == []


def length(function: ast.FunctionDef) -> int:
    first = function.body[0]
    is_docstring = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    described = (first.end_lineno or 0) - first.lineno + 1 if is_docstring else 0
    return (function.end_lineno or 0) - function.lineno + 1 - described
