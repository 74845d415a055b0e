"""Tasks from outside the package: registered, named as module:function, refused where they cannot be right."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import envs
from envs import engines, lookup, registry
from envs.registry import TASKS
from envs.task_info import physics_name
from envs.testing import check_environment
from tests.probe_envs import Counter, Walk

Module = Callable[..., str]
FILE = """
from tests.probe_envs import Walk
class Sized(Walk):
    physics_name = "by hand"
def make(width: int = 3, *, max_episode_steps: int = 20):
    return Sized(name=f"Walk{width}", max_episode_steps=max_episode_steps)
"""


@pytest.fixture(autouse=True)
def own_registry() -> Iterator[None]:
    """What a test registers is known to that test alone."""
    before = dict(TASKS)
    yield
    for name in set(TASKS) - set(before):
        registry._tasks.pop(name)


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Module]:
    """Writes a module into the current folder, which is no folder that Python looks in by itself."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    names = []

    def write(content: str, name: str = "their_tasks") -> str:
        (tmp_path / f"{name}.py").write_text(content, encoding="utf-8")
        names.append(name)
        return name

    yield write
    for name in names:
        sys.modules.pop(name, None)


def make_walk(max_episode_steps: int = 20, noise: float = 0.5) -> Walk:
    return Walk(max_episode_steps=max_episode_steps, action_bound=noise)


# Registered ----------------------------------------------------------------------------------------------------------


def test_a_registered_task_is_one_of_the_tasks() -> None:
    info = envs.register("Walk", make_walk, obs_dim=2, action_dim=1, cost_limit=3.0, cost="x, where positive")
    assert envs.TASKS["Walk"] is envs.find_task("Walk") is info
    assert list(envs.TASKS)[-1] == "Walk"
    assert (info.obs_dim, info.action_dim, info.cost_limit, info.original) == (2, 1, 3.0, None)
    assert (info.expert_preset, info.max_episode_steps) == ("expert", 20)
    assert dict(info.options) == {"noise": 0.5}
    env = envs.make("Walk")
    assert isinstance(env, Walk)
    assert (env.max_episode_steps, env.action_bound) == (20, 0.5)
    check_environment(env, num_steps=10)
    other = envs.make("Walk", max_episode_steps=5, options={"noise": 2.0})
    assert (other.max_episode_steps, other.action_bound) == (5, 2.0)  # type: ignore[attr-defined]
    assert envs.make("Walk", noise=2.0) == envs.make("Walk", options={"noise": 2.0})


def test_a_task_may_be_registered_by_a_text_that_is_looked_up_when_it_is_built(module: Module) -> None:
    """So that a package can register its tasks without importing JAX."""
    name = module("from their_missing_package import make")
    envs.register("Later", f"{name}:make", options={"width": 3})
    with pytest.raises(ValueError, match=r"importing module 'their_tasks' raised ModuleNotFoundError: No module named"):
        envs.make("Later")
    name = module(FILE.replace("*, ", "*, physics, num_threads=None, "), "their_other_tasks")
    envs.register("Other", f"{name}:make", options={"width": 4})
    env = envs.make("Other")
    assert (env.name, env.max_episode_steps) == ("Walk4", 1000)  # the options that were registered, and the usual limit
    assert envs.make("Other", options={"width": 5}).name == "Walk5"


def test_options_that_are_registered_take_the_place_of_the_signature() -> None:
    envs.register("Walk", lambda **options: make_walk(**options), options={"noise": 0.25})
    assert envs.make("Walk").action_bound == 0.25  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="Walk has no option 'max_episode_steps'; its options are noise"):
        envs.make("Walk", max_episode_steps=3)


def test_a_class_builds_its_environments() -> None:
    envs.register("Counter", Counter)
    assert envs.make("Counter", max_episode_steps=4) == Counter(max_episode_steps=4)


def test_nobody_writes_to_the_table() -> None:
    with pytest.raises(TypeError):
        envs.TASKS["Walk"] = envs.TASKS["Swimmer"]  # type: ignore[index]


@pytest.mark.parametrize(
    ("name", "build", "message"),
    [
        ("Swimmer", make_walk, "Swimmer: a task of this name is registered already; choose another"),
        ("Walk:1", make_walk, "'Walk:1': the name of a task is of letters"),
        ("", make_walk, "the name of a task is of letters"),
        ("a/b", make_walk, "the name of a task is of letters"),
        ("Walk", Walk(), "Walk: what builds a task must be a function or a class, not Walk"),
        ("Walk", lambda size: Walk(), "Walk: parameter 'size' of what builds the task must have a default value"),
        ("Walk", lambda num_threads: Walk(), "Walk: parameter 'num_threads' of what builds the task must have"),
        ("Walk", lambda size=1, /: Walk(), "Walk: parameter 'size' .* be given by keyword"),
        ("Walk", "make_walk", "make_walk: not of the form module:attribute"),
    ],
)
def test_what_cannot_be_registered(name: Any, build: Any, message: str) -> None:
    before = dict(envs.TASKS)
    with pytest.raises(ValueError, match=message) as error:
        envs.register(name, build)
    assert "\n" not in str(error.value)
    assert dict(envs.TASKS) == before


def test_a_task_is_registered_once() -> None:
    envs.register("Walk", make_walk)
    with pytest.raises(ValueError, match="Walk: a task of this name is registered already"):
        envs.register("Walk", make_walk)
    with pytest.raises(ValueError, match="did you mean Walk"):
        envs.make("walk")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"physics": "native"}, "Walk: physics 'native' has no effect, .*leave it out"),
        ({"physics": "bullet"}, "unknown physics"),
        ({"num_threads": 2}, "Walk has no option 'num_threads'; its options are max_episode_steps, noise"),
        ({"max_episode_steps": 0}, "Walk: max_episode_steps 0: must be a whole number"),
        ({"options": {"nois": 1.0}}, "Walk has no option 'nois'; did you mean noise"),
        ({"cost_threshold": 1.0}, "Walk has no option 'cost_threshold'"),
        ({"options": {"physics": "native"}}, "Walk has no option 'physics'"),
        ({"options": {"max_episode_steps": 3}, "max_episode_steps": 3}, "option 'max_episode_steps' is given twice"),
    ],
)
def test_options_that_a_registered_task_does_not_have(given: dict[str, Any], message: str) -> None:
    envs.register("Walk", make_walk)
    with pytest.raises(ValueError, match=message) as error:
        envs.make("Walk", **given)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("build", "sizes", "message"),
    [
        (lambda: None, {}, "Walk: what was built, a NoneType, has no name, obs_dim, .*; return an envs.Environment"),
        (make_walk, {"obs_dim": 3}, "Walk: obs_dim is 2, but registered as 3"),
        (make_walk, {"action_dim": 3}, "Walk: action_dim is 1, but registered as 3"),
    ],
)
def test_what_was_built_must_be_what_was_registered(build: Any, sizes: dict[str, int], message: str) -> None:
    envs.register("Walk", build, **sizes)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=message):
        envs.make("Walk")


# Named by a text -----------------------------------------------------------------------------------------------------


def test_a_function_in_the_current_folder_is_a_task(module: Module) -> None:
    text = f"{module(FILE)}:make"
    info = envs.find_task(text)
    assert (info.name, dict(info.options), info.max_episode_steps) == (text, {"width": 3}, 20)
    assert (info.obs_dim, info.action_dim, info.original, info.cost_limit) == (None, None, None, None)
    assert text not in envs.TASKS
    env = envs.make(text, max_episode_steps=7, options={"width": 5})
    assert (env.name, env.max_episode_steps) == ("Walk5", 7)
    assert physics_name(env) == "by hand"
    assert physics_name(Walk()) == "Walk"
    check_environment(env, num_steps=5)
    for given, message in (
        ({"physics": "mjx"}, "their_tasks:make: physics 'mjx' has no effect"),
        ({"options": {"depth": 1}}, "their_tasks:make has no option 'depth'; .*its options are max_episode_steps, w"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.make(text, **given)


def test_physics_is_passed_where_it_is_taken(module: Module) -> None:
    module("from tests.probe_envs import Walk\ndef make(physics):\n    return Walk(name=physics)")
    assert envs.make("their_tasks:make").name == "auto"
    assert envs.make("their_tasks:make", physics="native").name == "native"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("their_tasks:", "not of the form module:attribute; write for example my_package.tasks:make"),
        (":make", "not of the form"),
        ("their_tasks:make:x", "not of the form"),
        ("their tasks:make", "not of the form"),
        ("their_task:make", "their_task:make: there is no module 'their_task'; start in the folder that holds it"),
        ("their_tasks.inner:make", "there is no module 'their_tasks.inner'"),
        ("their_tasks:mak", "module 'their_tasks' has no attribute 'mak'; did you mean make"),
        ("their_tasks:make.inner", "module 'their_tasks' has no attribute 'make.inner'"),
        ("their_tasks:LENGTH", "their_tasks:LENGTH: what builds a task must be a function or a class, not int"),
        ("their_tasks:needs", "their_tasks:needs: parameter 'size' .* must have a default value"),
        ("their_broken:make", "importing module 'their_broken' raised ZeroDivisionError: division by zero"),
        ("their_program:make", "importing module 'their_program' raised SystemExit: 2"),
        ("their_import:make", "importing module 'their_import' raised ModuleNotFoundError: No module named 'their_mis"),
    ],
)
def test_a_text_that_names_no_task_is_refused_in_one_line(text: str, message: str, module: Module) -> None:
    module("LENGTH = 3\ndef make():\n    pass\ndef needs(size):\n    pass")
    module("1 / 0", "their_broken")
    module("import sys\nsys.exit(2)", "their_program")
    module("import their_missing", "their_import")
    for refuse in (envs.find_task, envs.make):
        with pytest.raises(ValueError, match=message) as error:
            refuse(text)
        assert "\n" not in str(error.value)


def test_lookup_finds_what_modules_hold(module: Module) -> None:
    assert lookup.named_object("envs.registry:TaskInfo.make") is registry.TaskInfo.make
    module("import their_neighbour\nthing = their_neighbour.thing")
    module("thing = 'found'", "their_neighbour")
    assert lookup.named_object("their_tasks:thing") == "found"


def test_looking_up_a_name_imports_no_jax(tmp_path: Path) -> None:
    """A task that is registered lazily is known at once, for `--help` and for checks of the input."""
    (tmp_path / "quick.py").write_text("def make(size=1):\n    import jax", encoding="utf-8")
    program = (
        "import sys, envs\n"
        "envs.register('Lazy', 'nowhere:make')\n"
        "assert dict(envs.find_task('quick:make').options) == {'size': 1}\n"
        "assert {'jax', 'mujoco', 'gymnasium', 'brax'}.isdisjoint(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)


# Engines -------------------------------------------------------------------------------------------------------------


def test_the_engines_are_the_rows_of_one_table() -> None:
    assert envs.PHYSICS == ("auto", *(engine.name for engine in engines.ENGINES)) == ("auto", "native", "mjx", "warp")
    for name in envs.PHYSICS[1:]:
        assert engines.find_engine(name).name == name
    assert sum(engine.is_fastest() for engine in engines.ENGINES) == 1
    with pytest.raises(ValueError, match="nativ: unknown physics; did you mean native"):
        engines.find_engine("nativ")


@pytest.mark.parametrize("task", ["Swimmer", "PointGoal1"])
def test_threads_of_an_engine_without_threads_are_refused(task: str) -> None:
    with pytest.raises(ValueError, match="num_threads 2 has no effect with physics 'mjx'; leave it out"):
        envs.make(task, physics="mjx", num_threads=2)
