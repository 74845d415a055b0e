"""Builds the task of a run, and checks one of a user's own before anything is compiled."""

import functools
from collections.abc import Mapping
from typing import Any

from ccil_jax import user_code
from ccil_jax.errors import UserError
from experiments.cli.command_line import UsageError


def build_environment(task: str, physics: str, options: Mapping[str, Any]) -> Any:
    """The task of a run. Imports JAX, so that it is called once all other input has been checked.

    Args:
        task: a key of `envs.TASKS`; or "module:attribute", what builds a task of the user's own.
        physics: the engine.
        options: of `envs.make`, besides the physics.

    Returns:
        An `envs.Environment`.

    Raises:
        UserError: the task cannot be built; or, one of the user's own, its `reset` and `step` do not go together.
    """
    import envs

    try:
        env = user_code.call(f"--env {task}", functools.partial(envs.make, task, physics=physics, **options))
    except UserError:
        raise
    except ValueError as error:
        raise UsageError(f"--env {error}") from error
    if ":" in task:
        _check_functions(task, env)
    return env


def _check_functions(task: str, env: Any) -> None:
    """Traces `reset` and `step` of one simulation. Raises `UserError` for other shapes or types than they must have."""
    import jax
    import jax.numpy as jnp

    import envs
    from ccil_jax.trees import difference

    action = jax.ShapeDtypeStruct((env.action_dim,), jnp.result_type(float))
    try:
        first = user_code.call(f"--env {task}: reset", jax.eval_shape, env.reset, jax.random.key(0))
        after = user_code.call(f"--env {task}: step", jax.eval_shape, env.step, first, action)
    except UserError:
        raise
    except ValueError as error:  # of `envs`, about what a function of the user's, such as a cost, has returned
        raise UsageError(f"--env {task}: {error}") from error
    wanted = {"obs": (env.obs_dim,), "reward": (), "cost": (), "terminated": (), "truncated": ()}
    for where, state in (("reset", first), ("step", after)):
        if not isinstance(state, envs.State):
            raise UsageError(f"--env {task}: {where} returned {type(state).__name__}; return an envs.State")
        for name, shape in wanted.items():
            if (found := getattr(state, name).shape) != shape:
                raise UsageError(f"--env {task}: {name} after {where} has shape {found}; make it {shape}")
    if differs := difference(first, after):
        raise UsageError(f"--env {task}: step returned a state of another form than reset ({differs}); let both agree")
