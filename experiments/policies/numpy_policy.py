"""Learnt policies in NumPy alone: for the original simulators, for drawings, and for programs without JAX."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ccil_jax.config import Config

_LAYER = ("kernel", "bias")
CLIP = 5.0  # of normalised observations, as in ccil_jax.acting.running_statistics
_MIN_STD = 1e-2
LOG_STD_RANGE = (-5.0, 2.0)  # of squashed policies, as in ccil_jax.acting.networks
_ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "swish": lambda x: x / (1 + np.exp(-x)),
}


def is_known(config: Config) -> bool:
    """Whether this file can compute the policy of a method: it is one of this package, not one of the user's own."""
    return config.row.policy in ("gaussian", "squashed")


class NumpyPolicy:
    """The forward pass of the policy of one seed, in float64.

    Args:
        config: of the policy.
        actor: the seed's `ccil_jax.acting.rollout.Actor`, without a seed axis.
        low: lower bounds of the actions, [action_dim], which may be infinite.
        high: upper bounds of the actions, [action_dim], which may be infinite.

    Actions are returned as they are executed, clipped to these bounds.
    """

    def __init__(self, config: Config, actor: Any, low: np.ndarray, high: np.ndarray) -> None:
        self._squashed = "squashed" in actor.policy_params
        layers = actor.policy_params["squashed" if self._squashed else "mean"]["params"]
        self._layers = [
            (np.asarray(layers[name]["kernel"], np.float64), np.asarray(layers[name]["bias"], np.float64))
            for name in sorted(layers, key=lambda name: int(name.rsplit("_", 1)[1]))
        ]
        self._activation = _ACTIVATIONS[config.activation]
        obs_dim = len(self._layers[0][0])
        self._mean, self._std, self._clip = np.zeros(obs_dim), np.ones(obs_dim), np.inf
        if (statistics := actor.obs_statistics) is not None:
            count, self._clip = float(statistics.count), CLIP
            self._mean = np.asarray(statistics.mean, np.float64)
            variance = np.asarray(statistics.sum_squares, np.float64) / max(count, 1.0)
            self._std = np.maximum(np.sqrt(variance), _MIN_STD) if count > 0 else np.ones_like(variance)
        self._low, self._high = low, high
        if self._squashed:
            self._center, self._half_range = (low + high) / 2, (high - low) / 2
        else:
            self._log_std = np.asarray(actor.policy_params["log_std"], np.float64)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays from which another program can compute the policy, as docs/commands.md describes it."""
        layers = {f"{name}_{i}": x for i, pair in enumerate(self._layers) for name, x in zip(_LAYER, pair, strict=True)}
        if self._squashed:
            last = {"action_center": self._center, "action_half_range": self._half_range}
        else:
            last = {"action_std": np.exp(self._log_std)}
        observed = {"obs_mean": self._mean, "obs_std": self._std, "obs_clip": np.asarray(self._clip)}
        return layers | last | observed | {"action_low": self._low, "action_high": self._high}

    def mode(self, obs: np.ndarray) -> np.ndarray:
        """The mode of the policy: [obs_dim] -> [action_dim], the action without noise."""
        return self._act(obs, np.zeros(len(self._low)))

    def sample(self, obs: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """An action drawn from the policy: [obs_dim] -> [action_dim]."""
        return self._act(obs, random.standard_normal(len(self._low)))

    def _act(self, obs: np.ndarray, noise: np.ndarray) -> np.ndarray:
        action: np.ndarray = np.clip(self._draw(obs, noise), self._low, self._high)
        return action

    def _draw(self, obs: np.ndarray, noise: np.ndarray) -> np.ndarray:
        x = np.clip((obs - self._mean) / self._std, -self._clip, self._clip)
        for kernel, bias in self._layers[:-1]:
            x = self._activation(x @ kernel + bias)
        kernel, bias = self._layers[-1]
        x = x @ kernel + bias
        if not self._squashed:
            return x + np.exp(self._log_std) * noise
        mean, spread = np.split(x, 2)
        smallest, largest = LOG_STD_RANGE
        log_std = smallest + (largest - smallest) * (np.tanh(spread) + 1) / 2
        return self._center + self._half_range * np.tanh(mean + np.exp(log_std) * noise)


def policies(config: Config, actor: Any, env: Any) -> list[NumpyPolicy]:
    """The policies of all seeds; `actor` is [num_seeds]-leading."""
    import jax

    low, high = np.asarray(env.action_low, np.float64), np.asarray(env.action_high, np.float64)
    seeds = range(len(jax.tree.leaves(actor)[0]))
    return [NumpyPolicy(config, jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i]), actor), low, high) for i in seeds]
