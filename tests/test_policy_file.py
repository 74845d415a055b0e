"""Files of policies: what is written is read again, and what is damaged or hostile is refused in one line."""

import json
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccil_jax.demonstrations import npz
from ccil_jax.demonstrations.npz import ArchiveError
from experiments.page import document, episodes
from experiments.policies import policy_file
from experiments.policies.numpy_policy import policies
from tests.test_commands import blocks
from tests.test_documentation import ROOT

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
    modes = np.stack([policies(file.config, actor, env)[1].mode(x) for x in obs])
    np.testing.assert_allclose(modes, np.clip(mean[1], -1, 1), rtol=1e-4, atol=1e-4)


BOUNDS = {
    "of one": ([-1.0, -1.0], [1.0, 1.0]),
    "of each entry": ([-2.0, 0.1], [0.25, 3.0]),
    "on one side": ([-np.inf, -0.5], [np.inf, np.inf]),
    "none": ([-np.inf, -np.inf], [np.inf, np.inf]),
}


@pytest.mark.parametrize(
    ("activation", "squashed", "bounds"),
    [
        ("tanh", False, "of one"),
        ("tanh", False, "none"),
        ("relu", False, "of each entry"),
        ("swish", False, "on one side"),
        ("tanh", True, "of each entry"),
        ("relu", True, "of one"),
        ("swish", True, "of each entry"),
    ],
)
def test_exports_give_the_actions_that_are_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, activation: str, squashed: bool, bounds: str
) -> None:
    """1,000 observations, with noise so large that many actions are clipped, and without: in each of the three forms.

    The oracle is the policy in JAX, whose actions NumPy clips. What the page shows does the same.
    """
    import jax
    import jax.numpy as jnp
    import onnxruntime

    from ccil_jax.acting import networks
    from ccil_jax.acting.rollout import act
    from experiments.policies import exporting

    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(1)
    low, high = (np.array(bound, np.float32) for bound in BOUNDS[bounds])
    env = types.SimpleNamespace(name="Boxed", obs_dim=8, action_dim=2, action_low=low, action_high=high)
    other = {"kernel_1": random.normal(size=(2, 5, 4)), "bias_1": random.normal(size=(2, 4)), "action_std": None}
    other |= {"action_center": np.zeros((2, 2)), "action_half_range": np.ones((2, 2)), "obs_clip": np.full(2, np.inf)}
    other |= {"obs_mean": np.zeros((2, 8)), "obs_std": np.ones((2, 8))}
    npz.write(Path("made.npz"), content(metadata={**METADATA, "activation": activation}, **(other if squashed else {})))
    file = policy_file.read(Path("made.npz"))
    actor, played = file.actor(), types.SimpleNamespace(episode_return=np.zeros((2, 3)), episode_cost=np.ones((2, 3)))
    exporting.export_numpy(Path("policy.npz"), file.config, actor, env, played, METADATA)
    exporting.export_onnx(Path("policy.onnx"), file.config, actor, env)
    exporting.export_stablehlo(Path("policy.stablehlo"), file.config, actor, env)
    assert policy_file.read(Path("policy.npz")).squashed == squashed

    session = onnxruntime.InferenceSession("policy.onnx", providers=["CPUExecutionProvider"])
    program = jax.export.deserialize(bytearray(Path("policy.stablehlo").read_bytes()))
    policy, obs = networks.policy_of(file.config, env), random.normal(size=(1000, 8)).astype(np.float32) * 3
    for noise in (np.zeros((1000, 2), np.float32), random.normal(size=(1000, 2)).astype(np.float32) * 3):
        drawn = jax.vmap(lambda one, noise=noise: act(policy.apply, one, jnp.asarray(obs), jnp.asarray(noise)))(actor)
        wanted = np.clip(drawn, low, high)
        assert squashed or bounds == "none" or np.mean(wanted != drawn) > 0.2
        (found,) = session.run(["action"], {"obs": obs, "noise": noise})
        assert found.shape == (2, 1000, 2)
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(program.call(obs, noise), wanted, rtol=1e-5, atol=1e-5)
        assert (found >= low).all()
        assert (found <= high).all()
    if activation == "tanh" and not squashed:
        check_the_page(obs, noise, wanted)


def check_the_page(obs: np.ndarray, noise: np.ndarray, wanted: np.ndarray) -> None:
    """The Python of docs/commands.md, with the files in the current folder, acts as the policies do."""
    page: dict[str, Any] = {}
    for block in blocks("docs/commands.md", "python"):
        exec(compile(block, "docs/commands.md", "exec"), page)  # noqa: S102  (the page is ours)
    np.testing.assert_allclose(page["act"](obs, noise), wanted[0], rtol=1e-4, atol=1e-4)
    assert page["actions"].shape == (2, 3, 2)
    np.testing.assert_allclose(page["actions"], page["same_actions"], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(page["actions"][0], page["act"](page["obs"], page["noise"]), rtol=1e-4, atol=1e-4)


def test_the_arrays_of_a_policy_are_those_of_the_page() -> None:
    """Every array that is read is in the table of docs/commands.md."""
    page = (ROOT / "docs/commands.md").read_text(encoding="utf-8")
    table = page.partition("| array | shape | meaning |")[2].partition("\n\n")[0]
    optional = {"action_center", "action_half_range", "action_low", "action_high", "episode_return", "episode_cost"}
    for name in (content().keys() | optional) - {"bias_1"}:
        assert f"`{name}`" in table


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
        ({"action_low": np.zeros((2, 2))}, "do not make up a policy"),  # without the other bound
        ({"action_low": np.ones((2, 2)), "action_high": np.zeros((2, 2))}, "do not make up a policy"),
        ({"action_low": np.zeros((2, 3)), "action_high": np.ones((2, 3))}, "do not make up a policy"),
        ({"action_low": np.zeros((2, 2)), "action_high": np.full((2, 2), np.nan)}, "do not make up a policy"),
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
        (
            {"metadata": {**METADATA, "training": {**METADATA["training"], "evaluated_action": "best"}}},
            "no known training.evaluated_action",
        ),
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
