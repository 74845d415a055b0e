"""Enters our tasks into gymnasium's registry as "ccil/<task>-v0". Imports gymnasium only when it has been imported.

Gymnasium 1.x looks for environments nowhere: a package enters its own, by convention when it is imported. But this
package must not import gymnasium, so that it stays quick to import. So where gymnasium is not there yet, its import is
watched, and the tasks are entered right after it.
"""

import functools
import importlib.abc
import importlib.machinery
import sys
from collections.abc import Sequence
from types import ModuleType

from envs.registry import TASKS

NAMESPACE = "ccil"


def register_with_gymnasium() -> None:
    """Enters all of `TASKS`, those that were registered by now included, into gymnasium's registry.

    Then `gymnasium.make("ccil/HalfCheetah-v0")` gives a `GymnasiumEnv` and `gymnasium.make_vec` of the same name a
    `GymnasiumVectorEnv`; both take the options of `envs.make`. What is entered already stays as it is. Built-in tasks
    are entered when `envs` has been imported, in either order; for tasks of `envs.register`, call this function.
    """
    from gymnasium.envs import registration

    for task in TASKS.values():
        name = f"{NAMESPACE}/{task.name}-v0"
        if name not in registration.registry:
            registration.register(
                name,
                entry_point="envs.adapters.gymnasium_env:make_single",
                vector_entry_point="envs.adapters.gymnasium_env:make_vector",
                max_episode_steps=task.max_episode_steps,
                kwargs={"task": task.name},
            )


class _AfterGymnasium(importlib.abc.MetaPathFinder):
    """Has the tasks entered once gymnasium has been imported, and leaves all other imports alone."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != "gymnasium":
            return None
        found = (finder.find_spec(name, path, target) for finder in sys.meta_path if finder is not self)
        spec = next(filter(None, found), None)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        @functools.wraps(execute)
        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            if self in sys.meta_path:  # it is not where somebody has kept an earlier spec and executes that as well
                sys.meta_path.remove(self)
                register_with_gymnasium()

        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


def register_once_imported() -> None:
    """`register_with_gymnasium`, at once if gymnasium has been imported, and otherwise as soon as it is."""
    if "gymnasium" in sys.modules:
        register_with_gymnasium()
    else:
        sys.meta_path.insert(0, _AfterGymnasium())
