"""Files of policies: what is written is read again, and what is damaged or hostile is refused in one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccil_jax.demonstrations import npz
from ccil_jax.demonstrations.npz import ArchiveError
from experiments.page import document, episodes
from experiments.policies import policy_file
from experiments.policies.numpy_policy import policies

TRAINING: dict[str, Any] = {
    "task": "Swimmer",
    "method": "malm",
    "env_options": {},
    "physics": "native",
    "cost_limit": 3.0,
}
METADATA: dict[str, Any] = {
    "activation": "tanh",
    "training": {**TRAINING, "seed_indices": [4, 7]},
    "levels": {"expert_return": 1.0, "expert_cost": 3.0},
}


def content(**changes: Any) -> dict[str, Any]:
    """Two Gaussian policies of Swimmer, 8 observations and 2 actions, with a hidden layer of 5."""
    random = np.random.default_rng(0)
    arrays: dict[str, Any] = {
        "kernel_0": random.normal(size=(2, 8, 5)),
        "bias_0": random.normal(size=(2, 5)),
        "kernel_1": random.normal(size=(2, 5, 2)),
        "bias_1": random.normal(size=(2, 2)),
        "action_std": np.exp(random.normal(size=(2, 2))),
        "obs_mean": random.normal(size=(2, 8)),
        "obs_std": np.exp(random.normal(size=(2, 8))),
        "obs_clip": np.full(2, 5.0),
        "metadata": METADATA,
        **changes,
    }
    arrays["metadata"] = np.array(json.dumps(arrays["metadata"]))
    return {name: values for name, values in arrays.items() if values is not None}


def test_policies_of_a_file_act_as_its_arrays_say(tmp_path: Path) -> None:
    """By hand: (obs - mean) / std, clipped, then tanh between two affine maps."""
    import jax
    import jax.numpy as jnp

    import envs
    from ccil_jax.acting import networks
    from ccil_jax.acting.rollout import act

    arrays, path = content(), tmp_path / "policy.npz"
    npz.write(path, arrays)
    file = policy_file.read(path)
    assert (file.num_policies, file.training["seed_indices"]) == (2, [4, 7])
    obs = np.random.default_rng(1).normal(size=(6, 8)) * 4
    x = np.clip((obs - arrays["obs_mean"][:, None]) / arrays["obs_std"][:, None], -5, 5)
    hidden = np.tanh(np.einsum("sni,sio->sno", x, arrays["kernel_0"]) + arrays["bias_0"][:, None])
    mean = np.einsum("sni,sio->sno", hidden, arrays["kernel_1"]) + arrays["bias_1"][:, None]

    env = envs.make("Swimmer")
    policy, actor, noise = networks.policy_of(file.config, env), file.actor(), np.ones((6, 2))
    found = jax.vmap(lambda one: act(policy.apply, one, jnp.asarray(obs, jnp.float32), jnp.asarray(noise)))(actor)
    np.testing.assert_allclose(found, mean + arrays["action_std"][:, None], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(policies(file.config, actor, env)[1].mode(obs[0]), mean[1, 0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("squashed", [False, True])
@pytest.mark.parametrize("activation", ["tanh", "relu", "swish"])
def test_onnx_acts_as_the_policies_do(tmp_path: Path, squashed: bool, activation: str) -> None:
    """1,000 observations, with noise and without: the model in its own runtime against JAX."""
    import jax
    import jax.numpy as jnp
    import onnxruntime

    import envs
    from ccil_jax.acting import networks
    from ccil_jax.acting.rollout import act
    from experiments.policies import exporting

    random = np.random.default_rng(1)
    other = {"kernel_1": random.normal(size=(2, 5, 4)), "bias_1": random.normal(size=(2, 4)), "action_std": None}
    other |= {"action_center": np.zeros((2, 2)), "action_half_range": np.ones((2, 2)), "obs_clip": np.full(2, np.inf)}
    other |= {"obs_mean": np.zeros((2, 8)), "obs_std": np.ones((2, 8))}
    path, env = tmp_path / "policy.npz", envs.make("Swimmer")
    npz.write(path, content(metadata={**METADATA, "activation": activation}, **(other if squashed else {})))
    file = policy_file.read(path)
    actor = file.actor()
    exporting.export_onnx(tmp_path / "policy.onnx", file.config, actor, env)
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    obs = random.normal(size=(1000, 8)).astype(np.float32) * 3
    policy = networks.policy_of(file.config, env)
    for noise in (np.zeros((1000, 2), np.float32), random.normal(size=(1000, 2)).astype(np.float32)):
        (found,) = session.run(["action"], {"obs": obs, "noise": noise})
        wanted = jax.vmap(lambda one, noise=noise: act(policy.apply, one, jnp.asarray(obs), jnp.asarray(noise)))(actor)
        assert found.shape == (2, 1000, 2)
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)


def without(*keys: str) -> dict[str, Any]:
    """The metadata without an entry of the training."""
    return {**METADATA, "training": {k: v for k, v in METADATA["training"].items() if k not in keys}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kernel_1": None}, "do not make up a policy"),
        ({"bias_0": np.zeros((2, 4))}, "do not make up a policy"),
        ({"kernel_1": np.zeros((2, 4, 2))}, "do not make up a policy"),
        ({"action_std": np.ones((2, 3))}, "do not make up a policy"),
        ({"action_std": None}, "do not make up a policy"),
        ({"obs_mean": np.zeros(8)}, "do not make up a policy"),
        ({"obs_clip": np.full(2, 10.0)}, "do not make up a policy"),
        ({"kernel_0": np.zeros((0, 8, 5))}, "do not make up a policy"),
        ({"episode_cost": np.zeros(2)}, "do not make up a policy"),
        ({"obs_clip": None}, "key 'obs_clip' is missing"),
        ({"bias_1": np.full((2, 2), np.nan)}, "'bias_1' holds something else than finite numbers"),
        ({"bias_1": np.full((2, 2), "a")}, "'bias_1' holds something else than finite numbers"),
        ({"obs_std": np.zeros((2, 8))}, "'obs_std' holds deviations that are not positive"),
        ({"metadata": []}, "not a JSON object"),
        ({"metadata": {}}, "does not say how the policies were trained"),
        ({"metadata": without("physics")}, "no sound training.physics"),
        ({"metadata": without("seed_indices")}, "no sound training.seed_indices"),
        ({"metadata": {**METADATA, "training": {**METADATA["training"], "seed_indices": [1]}}}, "do not make up"),
        ({"metadata": {**METADATA, "training": {**METADATA["training"], "cost_limit": "no"}}}, "training.cost_limit"),
        ({"metadata": {**METADATA, "activation": "eval"}}, "no known activation"),
        ({"metadata": {**METADATA, "levels": None}}, "no sound levels"),
        ({"metadata": {**METADATA, "levels": {"expert_return": "high"}}}, "no sound levels"),
    ],
)
def test_what_is_no_policy_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = tmp_path / "policy.npz"
    npz.write(path, content(**changes))
    with pytest.raises(ArchiveError, match=message) as refused:
        policy_file.read(path)
    assert str(refused.value).startswith(str(path))
    assert "write the file again with `evaluate --export`" in str(refused.value)


def test_policies_fit_their_task(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    npz.write(path, content())
    file = policy_file.read(path)
    file.check_sizes(8, 2)
    with pytest.raises(ArchiveError, match="8 observations and 2 actions, but Swimmer has 17 and 6"):
        file.check_sizes(17, 6)


def test_a_page_shows_the_policies_of_files(tmp_path: Path) -> None:
    """Their returns and costs, 3 +- 1 by hand, and an episode of each beside one of the task's expert.

    That of an unknown task is in the table, and a sentence says why it is not shown.
    """
    played = {
        "episode_return": np.array([[2.0, 4.0], [2.0, 4.0]]),
        "episode_cost": np.array([[2.0, 4.0], [5.0, 5.0]]),
    }
    npz.write(tmp_path / "a.npz", content(**played))
    npz.write(tmp_path / "b.npz", content(metadata={**METADATA, "training": {**METADATA["training"], "task": "a:b"}}))
    files = [policy_file.read(tmp_path / name) for name in ("a.npz", "b.npz")]
    page = document.page([], files=files, play_policy=episodes.of_policy)
    assert "<td>malm on Swimmer, seed 4</td><td>3.00 <small>&plusmn; 1.00</small></td>" in page
    assert "<td>5.00 <small>&plusmn; 0.00</small></td><td>3.00</td><td>-</td>" in page
    assert "<td>malm on a:b, seed 7</td><td>-</td>" in page
    assert "No episode of malm on a:b, seed 7 is shown: a:b is no task of this package" in page
    assert page.count("<canvas") == 4
    assert page.count("the shipped expert</") == 2
