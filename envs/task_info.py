"""What is known of a task without building it. Imports neither JAX nor an engine."""

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal

from envs.engines import AUTO, check_physics
from envs.lookup import hint, named_object
from envs.options import CHECKS, COMMON

MAX_EPISODE_STEPS = 1000  # control steps until an episode is truncated, where a task does not say otherwise
_MEMBERS = ("name", "obs_dim", "action_dim", "action_low", "action_high", "max_episode_steps", "reset", "step")


def _nothing() -> Mapping[str, Any]:
    return MappingProxyType({})


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskInfo:
    """What is known of a task without building it."""

    name: str
    build: Callable[..., Any] | str  # called with options by keyword, returns an `Environment`; or "module:attribute"
    family: str = "registered"  # which table the task is a row of, to list related tasks together
    # This task's own options, with the values that they have by default.
    options: Mapping[str, Any] = dataclasses.field(default_factory=_nothing)
    common: frozenset[str] = frozenset(COMMON)  # those of `envs.options.COMMON` that `build` takes
    obs_dim: int | None = None  # None: known only once the task is built
    action_dim: int | None = None  # None: known only once the task is built
    max_episode_steps: int | None = MAX_EPISODE_STEPS  # the default; None: known only once the task is built
    cost_limit: float | None = None  # default episode cost allowed to the expert that records demonstrations
    cost: str = ""  # what costs how much in a step, in words
    expert_preset: str = "expert"  # the hyperparameters that an expert starts from, a key of `ccil_jax.presets.PRESETS`
    original: str | None = None  # the environment that the task is compared with
    original_package: Literal["gymnasium", "safety_gymnasium"] | None = None  # which has that environment
    # What that environment's reward contains and the task's leaves out, in words; empty where the two are the same.
    reward_lacks: str = ""
    # Options of that environment which make its observations those of the task.
    original_options: Mapping[str, Any] = dataclasses.field(default_factory=_nothing)

    def make(self, physics: str, options: Mapping[str, Any]) -> Any:
        """Builds the task. `options` has any of its options; what is absent has the default.

        Raises:
            ValueError: the task has no such option, it cannot have that value, or what was built is no `Environment`
                of the sizes given here.
            ImportError: what the engine needs is not installed.
        """
        check_options(self, physics, options)
        arguments = {**self.options, **options}
        if "physics" in self.common:
            arguments["physics"] = physics
        if "max_episode_steps" in self.common and self.max_episode_steps is not None:
            arguments.setdefault("max_episode_steps", self.max_episode_steps)
        build = named_object(self.build) if isinstance(self.build, str) else self.build
        env = build(**arguments)
        if missing := [member for member in _MEMBERS if not hasattr(env, member)]:
            of_brax = hasattr(env, "observation_size") and hasattr(env, "action_size")
            raise ValueError(
                f"{self.name}: what was built, a {type(env).__name__}, has no {', '.join(missing)}; "
                f"return an envs.Environment{' (wrap it in envs.FromBrax)' if of_brax else ''}"
            )
        for member in ("obs_dim", "action_dim"):
            wanted, found = getattr(self, member), getattr(env, member)
            if wanted not in (None, found):
                raise ValueError(f"{self.name}: {member} is {found}, but registered as {wanted}; correct either")
        return env


def check_options(task: TaskInfo, physics: Any, options: Mapping[str, Any]) -> None:
    """Checks what `envs.make` was given besides the task.

    Raises:
        ValueError: the task has no such option, or it cannot have that value.
    """
    check_physics(physics)
    names = [name for name in dict.fromkeys([*COMMON, *task.options]) if name in {*task.common, *task.options}]
    listed = f"its options are {', '.join(names)}" if names else "it has no options"
    if physics != AUTO and "physics" not in names:
        raise ValueError(f"{task.name}: physics {physics!r} has no effect, the task has no such option; leave it out")
    for name, value in options.items():
        if name == "physics" or name not in names:
            raise ValueError(f"{task.name} has no option {name!r}; {hint(name, names)}{listed}")
        if name in CHECKS:
            CHECKS[name](f"{task.name}: {name}", value)


def physics_name(env: Any) -> str:
    """The engine that an environment runs on, for records; the name of its class where it does not say."""
    return str(getattr(env, "physics_name", type(env).__name__))
