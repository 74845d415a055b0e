"""Files of learnt policies for other programs: NumPy arrays, or a StableHLO program."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.config import Config
from ccil_jax.demonstrations import npz
from experiments.policies.numpy_policy import policies

PLATFORMS = ("cpu", "cuda", "tpu")


def export_numpy(path: Path, config: Config, actor: Any, env: Any, evaluation: Any, facts: dict[str, Any]) -> None:
    """Writes the policies of all seeds as NumPy arrays, [num_seeds]-leading, and the results of their episodes.

    Args:
        path: an `.npz` file.
        config: for the activation.
        actor: [num_seeds]-leading.
        env: for the range of actions.
        evaluation: `episode_return` and `episode_cost`, [num_seeds, num_episodes] each.
        facts: more metadata, to be written as JSON.
    """
    import jax

    arrays = jax.tree.map(lambda *seeds: np.stack(seeds), *[policy.arrays() for policy in policies(config, actor, env)])
    metadata = facts | {"activation": config.activation}
    npz.write(
        path,
        arrays
        | {name: np.asarray(getattr(evaluation, name)) for name in ("episode_return", "episode_cost")}
        | {"metadata": np.array(json.dumps(metadata))},
    )


def export_stablehlo(path: Path, config: Config, actor: Any, env: Any) -> None:
    """Writes the policies of all seeds, with their parameters, as one program for any number N of observations.

    `jax.export.deserialize(bytearray(path.read_bytes())).call(obs, noise)` maps observations [N, obs_dim] and standard
    normal noise [N, action_dim], float32, to actions [num_seeds, N, action_dim], not yet clipped to the task's range;
    zero noise gives the mode. It runs on CPU, CUDA and TPU, by the JAX that wrote it and newer ones.
    """
    import jax

    from ccil_jax.acting import networks
    from ccil_jax.acting.rollout import act

    policy = networks.policy_of(config, env)

    def actions(obs: jax.Array, noise: jax.Array) -> jax.Array:
        return jax.vmap(lambda one: act(policy.apply, one, obs, noise))(actor)

    (num_samples,) = jax.export.symbolic_shape("N")
    shapes = [jax.ShapeDtypeStruct((num_samples, width), np.float32) for width in (env.obs_dim, env.action_dim)]
    program = jax.export.export(jax.jit(actions), platforms=PLATFORMS)(*shapes)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_bytes(program.serialize())
    temporary.replace(path)
