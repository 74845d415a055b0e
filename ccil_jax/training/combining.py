"""Several configurations in one program: what they share, in what they differ, and whose runs are where."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from ccil_jax.config import Config, field_names
from ccil_jax.errors import ConfigError


def columns(num_configs: int, num_seeds: int) -> list[slice]:
    """Where each configuration's runs are among all runs of a program, whose order is configuration by configuration.

    Entry i is a slice of the axis [num_configs * num_seeds]: the seeds of configuration i.
    """
    return [slice(i * num_seeds, (i + 1) * num_seeds) for i in range(num_configs)]


def join(configs: Sequence[Config], num_seeds: int) -> tuple[Config, dict[str, jax.Array]]:
    """The one program that can train all these configurations.

    Returns:
        The first configuration, which stands for all, and the values [num_configs * num_seeds] of the traced fields in
        which they differ, by name.

    Raises:
        ConfigError: the configurations differ in a static field, so that they need programs of their own.
    """
    first = configs[0]
    for name in field_names(traced=False):
        values = sorted({str(getattr(config, name)) for config in configs})
        if len(values) > 1:
            raise ConfigError(f"{name} {' and '.join(values)}: only traced fields may differ within one program")
    varied = {}
    for name in field_names(traced=True):
        of_config = [getattr(config, name) for config in configs]
        if any(value != of_config[0] for value in of_config):
            varied[name] = jnp.repeat(jnp.asarray(of_config, jnp.result_type(float)), num_seeds)
    return first, varied
