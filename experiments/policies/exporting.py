"""Files of learnt policies for other programs: NumPy arrays, an ONNX model, or a StableHLO program."""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.config import Config
from ccil_jax.demonstrations import npz
from experiments.policies.numpy_policy import LOG_STD_RANGE, policies

PLATFORMS = ("cpu", "cuda", "tpu")
_OPSET, _IR_VERSION = 17, 8  # of 2022, which every runtime in use reads


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
    arrays = _arrays(config, actor, env)
    metadata = facts | {"activation": config.activation}
    npz.write(
        path,
        arrays
        | {name: np.asarray(getattr(evaluation, name)) for name in ("episode_return", "episode_cost")}
        | {"metadata": np.array(json.dumps(metadata))},
    )


def _arrays(config: Config, actor: Any, env: Any) -> dict[str, np.ndarray]:
    """The arrays of the policies of all seeds, [num_seeds]-leading; see `NumpyPolicy.arrays`."""
    seeds = [policy.arrays() for policy in policies(config, actor, env)]
    return {name: np.stack([arrays[name] for arrays in seeds]) for name in seeds[0]}


def export_onnx(path: Path, config: Config, actor: Any, env: Any) -> None:
    """Writes the policies of all seeds, with their parameters, as one ONNX model for any number N of observations.

    Its inputs are `obs` [N, obs_dim] and standard normal `noise` [N, action_dim], float32; zero noise gives the mode.
    Its output is `action` [num_seeds, N, action_dim] as it is executed, clipped to the task's bounds. Needs the package
    `onnx`.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []

    def constant(name: str, values: np.ndarray) -> str:
        constants.append(numpy_helper.from_array(np.asarray(values, np.float32), name))
        return name

    def node(operator: str, *inputs: str, output: str | None = None) -> str:
        output = output or f"{operator}_{len(nodes)}"
        nodes.append(helper.make_node(operator, list(inputs), [output]))
        return output

    def wide(name: str) -> str:
        return constant(name, arrays[name][:, None])  # [num_seeds, 1, width], for all N observations

    arrays = _arrays(config, actor, env)
    x = node("Div", node("Sub", "obs", wide("obs_mean")), wide("obs_std"))
    if np.isfinite(clip := arrays["obs_clip"][0]):
        x = node("Clip", x, constant("lowest", -clip), constant("highest", clip))
    depth = sum(name.startswith("kernel_") for name in arrays)
    for i in range(depth):
        x = node("Add", node("MatMul", x, constant(f"kernel_{i}", arrays[f"kernel_{i}"])), wide(f"bias_{i}"))
        if i < depth - 1:
            x = _activated(config.activation, x, node)
    if "action_std" in arrays:
        x = node("Add", x, node("Mul", wide("action_std"), "noise"))
    else:
        x = _squashed(x, env.action_dim, node, constant, wide)
    # ONNX's Clip has one bound for all entries. An infinite bound leaves the actions as they are.
    x = node("Max", x, wide("action_low")) if np.isfinite(arrays["action_low"]).any() else x
    x = node("Min", x, wide("action_high")) if np.isfinite(arrays["action_high"]).any() else x
    node("Identity", x, output="action")
    obs_dim, action_dim = arrays["kernel_0"].shape[1], env.action_dim
    graph = helper.make_graph(
        nodes,
        "policies",
        [
            helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["N", obs_dim]),
            helper.make_tensor_value_info("noise", TensorProto.FLOAT, ["N", action_dim]),
        ],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [len(arrays["kernel_0"]), "N", action_dim])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
    onnx.checker.check_model(model, full_check=True)
    _write(path, model.SerializeToString())


Node = Callable[..., str]  # operator, names of its inputs -> name of its output


def _activated(activation: str, x: str, node: Node) -> str:
    if activation == "swish":
        return node("Mul", x, node("Sigmoid", x))
    return node({"tanh": "Tanh", "relu": "Relu"}[activation], x)


def _squashed(
    x: str, action_dim: int, node: Node, constant: Callable[[str, Any], str], wide: Callable[[str], str]
) -> str:
    """center + half_range tanh(mean + std noise); x holds the means, then what becomes the log-deviations."""
    smallest, largest = LOG_STD_RANGE
    # Products with halves of the identity take the two parts of x.
    first, last = np.eye(2 * action_dim)[:, :action_dim], np.eye(2 * action_dim)[:, action_dim:]
    mean, spread = node("MatMul", x, constant("first", first)), node("MatMul", x, constant("last", last))
    share = node("Add", node("Tanh", spread), constant("one", np.ones(1)))
    scaled = node("Mul", share, constant("half_span", np.full(1, (largest - smallest) / 2)))
    std = node("Exp", node("Add", scaled, constant("smallest", np.full(1, smallest))))
    unit = node("Tanh", node("Add", mean, node("Mul", std, "noise")))
    return node("Add", wide("action_center"), node("Mul", wide("action_half_range"), unit))


def _write(path: Path, content: bytes) -> None:
    """Whole or not at all."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_bytes(content)
    temporary.replace(path)


def export_stablehlo(path: Path, config: Config, actor: Any, env: Any) -> None:
    """Writes the policies of all seeds, with their parameters, as one program for any number N of observations.

    `jax.export.deserialize(bytearray(path.read_bytes())).call(obs, noise)` maps observations [N, obs_dim] and standard
    normal noise [N, action_dim], float32, to actions [num_seeds, N, action_dim], not yet clipped to the task's range;
    zero noise gives the mode. It runs on CPU, CUDA and TPU, by the JAX that wrote it and newer ones.
    """
    import jax

    from ccil_jax.acting import networks
    from ccil_jax.acting.rollout import act
    from envs.base import executed

    policy, clipped = networks.policy_of(config, env), jax.vmap(functools.partial(executed, env))

    def actions(obs: jax.Array, noise: jax.Array) -> jax.Array:
        return jax.vmap(lambda one: clipped(act(policy.apply, one, obs, noise)))(actor)

    (num_samples,) = jax.export.symbolic_shape("N")
    shapes = [jax.ShapeDtypeStruct((num_samples, width), np.float32) for width in (env.obs_dim, env.action_dim)]
    program = jax.export.export(jax.jit(actions), platforms=PLATFORMS)(*shapes)
    _write(path, bytes(program.serialize()))
