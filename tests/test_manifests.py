"""Checkpoints that can be believed: damage is found and named, other programs are refused, the newest good one is used.

Small states without training; `test_resume` and `tests/faults.py` do the same with whole runs.
"""

import dataclasses
import errno
import json
import logging
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ccil_jax.config import Config
from ccil_jax.errors import CheckpointError, LockedError
from ccil_jax.training import checkpointing, filesystem, manifests
from ccil_jax.training.checkpointing import Checkpointer
from ccil_jax.training.manifests import Identity
from tests.probe_envs import assert_same_bits

CONFIG = Config(method="lgail", cost_limit=1.0)
IDENTITY = Identity(
    configs=(CONFIG, CONFIG.replace(cost_limit=2.0)),
    num_seeds=1,
    seed=0,
    task="Walk",
    max_episode_steps=100,
    demonstrations="ab12",
)


def state(step: int) -> dict[str, Any]:
    """Every kind of leaf that a run has."""
    return {
        "params": {"kernel": jnp.linspace(0.0, step, 500).reshape(2, 250), "bias": np.full((2, 3), step, np.float64)},
        "count": jnp.full((2,), step, jnp.int32),
        "bits": jnp.arange(4, dtype=jnp.uint32),
        "flags": jnp.asarray([True, False]),
        "key": jax.random.split(jax.random.key(step)),
    }


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoints")
    with Checkpointer(folder, IDENTITY) as checkpoints:
        for step in (1, 2, 3):
            checkpoints.save(step, state(step))
    return folder


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "checkpoints"))


def shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)


def test_what_is_saved_comes_back(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == ["2", "3"]
    with Checkpointer(folder, IDENTITY) as checkpoints:
        assert checkpoints.latest_step() == 3
        assert_same_bits(checkpoints.restore(3, shapes(state(0))), state(3))
    manifest = json.loads((folder / "3" / manifests.NAME).read_text())
    assert manifest["arrays"]["params.kernel"]["shape"] == [2, 250]
    assert manifest["arrays"]["key"]["dtype"] == "key<fry>"
    assert [config["cost_limit"] for config in manifest["identity"]["configs"]] == [1.0, 2.0]
    assert manifest["identity"]["demonstrations"] == "ab12"
    assert "jax" in manifest["versions"]


def test_every_flipped_bit_is_found(folder: Path) -> None:
    """200 places, in every file of the step, the manifest included."""
    random = np.random.default_rng(0)
    files = sorted(path for path in (folder / "3").rglob("*") if path.is_file() and path.stat().st_size)
    for number in range(200):
        path = files[number % len(files)]
        before = path.read_bytes()
        content = bytearray(before)
        content[random.integers(len(content))] ^= 1 << random.integers(8)
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match=path.name):
            manifests.read(folder / "3")
        path.write_bytes(before)
    manifests.read(folder / "3")


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1] if path.stat().st_size else b"x")


@pytest.mark.parametrize("spoil", [truncate, lambda path: path.write_bytes(b"?"), Path.unlink])
def test_the_newest_good_step_is_used(
    folder: Path, spoil: Callable[[Path], Any], caplog: pytest.LogCaptureFixture
) -> None:
    """Whichever file of the newest step is damaged; the warning names it, and the next save is not in its way."""
    files = sorted(path.relative_to(folder) for path in (folder / "3").rglob("*") if path.is_file())
    assert len(files) > 5
    for file in files:
        copy = folder.with_name(f"copy-{file.name}")
        shutil.copytree(folder, copy)
        spoil(copy / file)
        caplog.clear()
        with Checkpointer(copy, IDENTITY, readonly=True) as reader, caplog.at_level(logging.WARNING):
            assert reader.latest_step() == 2
        assert f"{file}: " in caplog.text
        assert "going on from step 2" in caplog.text
        shutil.rmtree(copy)
    spoil(folder / files[0])
    with Checkpointer(folder, IDENTITY) as checkpoints:
        step = checkpoints.latest_step()
        assert step == 2
        assert_same_bits(checkpoints.restore(2, shapes(state(0))), state(2))
        checkpoints.save(3, state(3))
        assert checkpoints.latest_step() == 3


def test_an_unfinished_step_is_no_checkpoint(tmp_path: Path) -> None:
    """Killed between orbax's commit and the manifest, in the first save of all: the run starts over."""
    with Checkpointer(tmp_path, IDENTITY) as checkpoints:
        checkpoints.save(1, state(1))
        (tmp_path / "1" / manifests.NAME).unlink()
        assert checkpoints.latest_step() is None
        checkpoints.save(1, state(1))
        assert checkpoints.latest_step() == 1


def test_nothing_intact_is_an_error(folder: Path) -> None:
    for step in ("2", "3"):
        truncate(folder / step / manifests.NAME)
    with Checkpointer(folder, IDENTITY) as checkpoints, pytest.raises(CheckpointError, match="no other is intact"):
        checkpoints.latest_step()
    assert (folder / "3").exists()


OTHERS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "dtype": (lambda s: {**s, "count": s["count"].astype(jnp.float32)}, "count was written with dtype int32"),
    "shape": (lambda s: {**s, "bits": s["bits"][:3]}, r"bits was written with shape \[4\], this program has \[3\]"),
    "missing": (lambda s: {k: v for k, v in s.items() if k != "flags"}, "flags was written with dtype bool"),
    "new": (lambda s: {**s, "more": s["count"]}, "more was written with dtype None"),
    "key": (lambda s: {**s, "key": jax.random.key_data(s["key"])}, "key was written with dtype key<fry>"),
}


@pytest.mark.parametrize(("change", "message"), OTHERS.values(), ids=list(OTHERS))
def test_another_program_is_refused(folder: Path, change: Callable[[dict[str, Any]], Any], message: str) -> None:
    with Checkpointer(folder, IDENTITY) as checkpoints, pytest.raises(CheckpointError, match=message):
        checkpoints.restore(3, shapes(change(state(0))))


def other(**changes: Any) -> Identity:
    return dataclasses.replace(IDENTITY, **changes)


STRANGERS: dict[str, tuple[Identity, str]] = {
    "first configuration": (
        other(configs=(CONFIG.replace(max_kl=0.5), IDENTITY.configs[1])),
        r"written with max_kl 0\.01, this run has 0\.5",
    ),
    "second configuration": (
        other(configs=(CONFIG, CONFIG.replace(cost_limit=3.0))),
        r"written with cost_limit 2\.0, this run has 3\.0",
    ),
    "order of the configurations": (other(configs=IDENTITY.configs[::-1]), r"cost_limit 1\.0, this run has 2\.0"),
    "fewer configurations": (other(configs=(CONFIG,)), "written with number of configurations 2, this run has 1"),
    "seed": (other(seed=7), "written with seed 0, this run has 7"),
    "number of seeds": (other(num_seeds=2), "written with num_seeds 1, this run has 2"),
    "task": (other(task="Sign"), "written with task Walk, this run has Sign"),
    "time limit": (other(max_episode_steps=50), "written with max_episode_steps 100, this run has 50"),
    "demonstrations": (other(demonstrations="cd34"), "written with demonstrations ab12, this run has cd34"),
}


@pytest.mark.parametrize(("identity", "message"), STRANGERS.values(), ids=list(STRANGERS))
def test_another_training_is_refused(folder: Path, identity: Identity, message: str) -> None:
    with Checkpointer(folder, identity) as checkpoints, pytest.raises(CheckpointError, match=message):
        checkpoints.restore(3, shapes(state(0)))


@pytest.mark.parametrize(
    "identity",
    [
        other(configs=tuple(config.replace(env_steps=10**9) for config in IDENTITY.configs)),  # for longer
        other(configs=tuple(config.replace(gate="episode") for config in IDENTITY.configs)),  # lgail has no gate
        other(seed=None, demonstrations=None),  # not known
        other(seed=np.int64(0), configs=tuple(config.replace(num_envs=np.int32(16)) for config in IDENTITY.configs)),
    ],
)
def test_what_makes_no_difference_is_not_compared(folder: Path, identity: Identity) -> None:
    with Checkpointer(folder, identity) as checkpoints:
        checkpoints.restore(3, shapes(state(0)))


def test_a_field_that_may_move_is_not_compared(folder: Path) -> None:
    identity = other(configs=(CONFIG.replace(cost_limit=5.0), CONFIG.replace(cost_limit=6.0, max_kl=0.5)))
    with Checkpointer(folder, identity, free=frozenset({"cost_limit", "max_kl"})) as checkpoints:
        checkpoints.restore(3, shapes(state(0)))


def rewrite(step: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Changes the manifest of a step, whose digest then agrees with it, as another version would have written it."""
    manifest = json.loads((step / manifests.NAME).read_text())
    del manifest["sha256"]
    change(manifest)
    (step / manifests.NAME).write_text(json.dumps({**manifest, "sha256": manifests._sha256(manifest)}))


def of_earlier_version(manifest: dict[str, Any]) -> None:
    """Before the policy could begin with a clone."""
    for config in manifest["identity"]["configs"]:
        for name in ("action_likelihood", "cloning_updates", "warmup_iterations", "cloning_weight", "gap_unit"):
            del config[name]
        config["bc_epochs"] = 200


def test_a_field_that_a_checkpoint_does_not_name_has_its_default(folder: Path) -> None:
    rewrite(folder / "3", of_earlier_version)
    with Checkpointer(folder, IDENTITY) as checkpoints:
        assert_same_bits(checkpoints.restore(3, shapes(state(0))), state(3))
    for name, default, value in (("action_likelihood", "gaussian", "censored"), ("cloning_updates", 0, 100)):
        identity = other(configs=(CONFIG.replace(**{name: value}), IDENTITY.configs[1]))
        message = f"written with {name} {default}, this run has {value}"
        with Checkpointer(folder, identity) as checkpoints, pytest.raises(CheckpointError, match=message):
            checkpoints.restore(3, shapes(state(0)))


def test_a_field_that_is_gone_matters_to_the_methods_that_read_it(folder: Path) -> None:
    cloning = Config(method="bc", cloning_updates=100)

    def of_cloning(manifest: dict[str, Any]) -> None:
        manifest["identity"]["configs"][0]["method"] = "bc"
        of_earlier_version(manifest)

    rewrite(folder / "3", of_cloning)
    identity = other(configs=(cloning, IDENTITY.configs[1]))
    message = "3: written with bc_epochs 200 by an earlier version: bc now counts gradient steps .*; continue with the"
    with Checkpointer(folder, identity) as checkpoints, pytest.raises(CheckpointError, match=message):
        checkpoints.check_identity(3)
    identity = other(configs=(cloning.replace(cloning_updates=0), IDENTITY.configs[1]))
    with Checkpointer(folder, identity, free=frozenset({"bc_epochs"})) as checkpoints:  # as for acting alone
        assert_same_bits(checkpoints.restore(3, shapes(state(0))), state(3))


def test_a_field_of_a_later_version_is_refused(folder: Path) -> None:
    rewrite(folder / "3", lambda manifest: manifest["identity"]["configs"][1].update(new_field=3))
    message = "written with new_field 3, this run has None"
    with Checkpointer(folder, IDENTITY) as checkpoints, pytest.raises(CheckpointError, match=message):
        checkpoints.check_identity(3)


def test_a_checkpoint_of_before_there_were_identities_is_compared_by_its_configuration(folder: Path) -> None:
    def drop(manifest: dict[str, Any]) -> None:
        manifest["config"] = manifest.pop("identity")["configs"][0]

    rewrite(folder / "3", drop)
    with Checkpointer(folder, other(seed=7)) as checkpoints:
        checkpoints.restore(3, shapes(state(0)))
    identity = other(configs=(CONFIG.replace(gamma=0.5),))
    with Checkpointer(folder, identity) as checkpoints, pytest.raises(CheckpointError, match="gamma"):
        checkpoints.restore(3, shapes(state(0)))


def test_a_step_that_is_there_is_never_saved_over(folder: Path) -> None:
    """Orbax would decline in silence, and a new manifest beside old files would make them look damaged."""
    with Checkpointer(folder, IDENTITY) as checkpoints:
        with pytest.raises(CheckpointError, match="3: exists already"):
            checkpoints.save(3, state(7))
        with pytest.raises(CheckpointError, match="1: not saved, as"):
            checkpoints.save(1, state(1))
        assert checkpoints.latest_step() == 3
        assert_same_bits(checkpoints.restore(3, shapes(state(0))), state(3))
        with pytest.raises(CheckpointError, match=r"holds checkpoints already \(steps 2, 3\)"):
            checkpoints.check_empty()


def test_what_is_replaced_is_set_aside_whole(folder: Path) -> None:
    with Checkpointer(folder, IDENTITY) as checkpoints:
        before = (folder / "3" / manifests.NAME).read_bytes()
        checkpoints.replace(3, state(3))  # the same arrays: nothing to do
        assert (folder / "3" / manifests.NAME).read_bytes() == before
        checkpoints.replace(2, state(7))
        assert sorted(path.name for path in folder.iterdir()) == ["2", "2.replaced", "3.replaced"]
        assert checkpoints.latest_step() == 2
        assert_same_bits(checkpoints.restore(2, shapes(state(0))), state(7))
    assert (folder / "3.replaced" / manifests.NAME).read_bytes() == before
    manifests.read(folder / "2.replaced")
    with Checkpointer(folder, IDENTITY) as checkpoints:
        checkpoints.replace(2, state(8))  # what was set aside before stays too
    assert sorted(path.name for path in folder.iterdir()) == ["2", "2.replaced", "2.replaced-2", "3.replaced"]


def test_a_path_that_orbax_takes_for_a_pattern_is_refused(tmp_path: Path) -> None:
    """It would commit a step whose arrays are not there."""
    with pytest.raises(CheckpointError, match=r"run\[0\].*: checkpoints cannot be kept below a folder with \["):
        Checkpointer(tmp_path / "run[0]" / "checkpoints", IDENTITY)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_ends_the_run_now(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the save, where the space is known to be short; in the save, where it runs out behind our back."""
    with Checkpointer(folder, IDENTITY) as checkpoints:
        usage = shutil.disk_usage(folder)._replace(free=1000)
        with monkeypatch.context() as patch:
            patch.setattr(checkpointing.shutil, "disk_usage", lambda path: usage)
            with pytest.raises(CheckpointError, match=r"1,000 are free.*steps kept: 2, 3"):
                checkpoints.save(4, state(4))

        def fail(*_: Any) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(manifests, "write", fail)
            with pytest.raises(CheckpointError, match=r"4: no space left"):
                checkpoints.save(4, state(4))
        assert checkpoints.latest_step() == 3


def test_two_writers_are_refused_and_a_killed_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "run.lock"
    code = (
        f"import sys, pathlib; sys.path.insert(0, {str(Path(__file__).parent.parent)!r})\n"
        "from ccil_jax.training import filesystem\n"
        f"with filesystem.hold(pathlib.Path({str(path)!r})): print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout and other.stdout.readline() == "held\n"
        with pytest.raises(LockedError, match=f"in use by process {other.pid} on "), filesystem.hold(path):
            pass
        other.kill()
    with filesystem.hold(path), pytest.raises(LockedError), filesystem.hold(path):
        pass
