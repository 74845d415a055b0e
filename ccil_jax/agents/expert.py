"""Demonstrations as arrays on the device, in the form that learners take them."""

import jax
import jax.numpy as jnp
import numpy as np

from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.types import ExpertData, ExpertTransitions


def expert_data(demonstrations: Demonstrations | None) -> ExpertData | None:
    """Demonstrations as device arrays; the last tenth of the steps is held out from the discriminator."""
    if demonstrations is None:
        return None
    num_training = max(1, demonstrations.obs.shape[0] * 9 // 10)
    held_out = slice(min(num_training, demonstrations.obs.shape[0] - 1), None)
    return ExpertData(
        obs=_real(demonstrations.obs[:num_training]),
        action=_real(demonstrations.actions[:num_training]),
        held_out_obs=_real(demonstrations.obs[held_out]),
        held_out_action=_real(demonstrations.actions[held_out]),
        transitions=expert_transitions(demonstrations),
    )


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
