"""Demonstrations as arrays on the device, in the form that learners take them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.types import ExpertData, ExpertTransitions
from envs.base import Environment, Mirror, mirror_of


def expert_of(config: Config, env: Environment, demonstrations: Demonstrations | None) -> ExpertData | None:
    """What the methods learn from: the demonstrations, with their mirror images where `config` and the task say so."""
    symmetric = config.mirrored_demonstrations == "symmetric_tasks"
    return expert_data(demonstrations, mirror_of(env) if symmetric else None)


def expert_data(demonstrations: Demonstrations | None, mirror: Mirror | None = None) -> ExpertData | None:
    """Demonstrations as device arrays; the last tenth of the steps is held out from the discriminator.

    With a mirror symmetry the mirror images of all steps follow the steps themselves. Those of held-out steps are held
    out too, so that nothing is known of them.
    """
    if demonstrations is None:
        return None
    num_training = max(1, demonstrations.obs.shape[0] * 9 // 10)
    held_out = slice(min(num_training, demonstrations.obs.shape[0] - 1), None)
    data = ExpertData(
        obs=_real(demonstrations.obs[:num_training]),
        action=_real(demonstrations.actions[:num_training]),
        held_out_obs=_real(demonstrations.obs[held_out]),
        held_out_action=_real(demonstrations.actions[held_out]),
        transitions=expert_transitions(demonstrations),
    )
    return data if mirror is None else _with_images(data, mirror)


def _with_images(data: ExpertData, mirror: Mirror) -> ExpertData:
    """Every array with the mirror image of each of its rows after them; flags are their own image."""

    def both(path: tuple[Any, ...], rows: jax.Array) -> jax.Array:
        name = path[-1].name
        images = mirror.obs(rows) if name.endswith("obs") else mirror.action(rows) if name.endswith("action") else rows
        return jnp.concatenate([rows, images])

    doubled: ExpertData = jax.tree_util.tree_map_with_path(both, data)
    return doubled


def expert_transitions(demonstrations: Demonstrations) -> ExpertTransitions:
    """The steps whose successor is known: an episode's last step is one only where the task ended."""
    ends, obs = demonstrations.episode_ends, demonstrations.obs
    last = np.zeros(len(obs), bool)
    last[ends - 1] = True
    known = np.flatnonzero(~last | demonstrations.terminated)
    return ExpertTransitions(
        obs=_real(obs[known]),
        action=_real(demonstrations.actions[known]),
        next_obs=_real(obs[np.minimum(known + 1, len(obs) - 1)]),
        terminated=_real(demonstrations.terminated[known]),
        initial_obs=_real(obs[np.concatenate([[0], ends[:-1]])]),
    )


def _real(values: np.ndarray) -> jax.Array:
    """As a device array of JAX's real numbers: float32, or float64 where the user has asked for that."""
    return jnp.asarray(values, jnp.result_type(float))
