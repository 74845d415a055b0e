"""Checkpoints that can be believed: damage is found and named, other programs are refused, the newest good one is used.

Small states without training; `test_resume` and `tests/faults.py` do the same with whole runs.
"""

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

from ccil_jax import checkpointing, digests, files
from ccil_jax.checkpointing import Checkpointer
from ccil_jax.config import Config
from ccil_jax.digests import CheckpointError
from ccil_jax.files import LockedError
from tests.probe_envs import same_bits

CONFIG = Config(cost_limit=1.0)


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
    with Checkpointer(folder, CONFIG) as checkpoints:
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
    with Checkpointer(folder, CONFIG) as checkpoints:
        assert checkpoints.latest_step() == 3
        assert same_bits(checkpoints.restore(3, shapes(state(0))), state(3))
    manifest = json.loads((folder / "3" / digests.NAME).read_text())
    assert manifest["arrays"]["params.kernel"]["shape"] == [2, 250]
    assert manifest["arrays"]["key"]["dtype"] == "key<fry>"
    assert manifest["config"]["max_kl"] == CONFIG.max_kl
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
            digests.read(folder / "3")
        path.write_bytes(before)
    digests.read(folder / "3")


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
        with Checkpointer(copy, CONFIG, readonly=True) as reader, caplog.at_level(logging.WARNING):
            assert reader.latest_step() == 2
        assert f"{file}: " in caplog.text
        assert "going on from step 2" in caplog.text
        shutil.rmtree(copy)
    spoil(folder / files[0])
    with Checkpointer(folder, CONFIG) as checkpoints:
        step = checkpoints.latest_step()
        assert step == 2
        assert same_bits(checkpoints.restore(2, shapes(state(0))), state(2))
        checkpoints.save(3, state(3))
        assert checkpoints.latest_step() == 3


def test_an_unfinished_step_is_no_checkpoint(tmp_path: Path) -> None:
    """Killed between orbax's commit and the manifest, in the first save of all: the run starts over."""
    with Checkpointer(tmp_path, CONFIG) as checkpoints:
        checkpoints.save(1, state(1))
        (tmp_path / "1" / digests.NAME).unlink()
        assert checkpoints.latest_step() is None
        checkpoints.save(1, state(1))
        assert checkpoints.latest_step() == 1


def test_nothing_intact_is_an_error(folder: Path) -> None:
    for step in ("2", "3"):
        truncate(folder / step / digests.NAME)
    with Checkpointer(folder, CONFIG) as checkpoints, pytest.raises(CheckpointError, match="no other is intact"):
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
    with Checkpointer(folder, CONFIG) as checkpoints, pytest.raises(CheckpointError, match=message):
        checkpoints.restore(3, shapes(change(state(0))))


def test_another_configuration_is_refused(folder: Path) -> None:
    with (
        Checkpointer(folder, CONFIG.replace(max_kl=0.5)) as checkpoints,
        pytest.raises(CheckpointError, match=r"written with max_kl 0\.01, this run has 0\.5"),
    ):
        checkpoints.restore(3, shapes(state(0)))
    with Checkpointer(folder, CONFIG.replace(env_steps=10**9)) as checkpoints:
        checkpoints.restore(3, shapes(state(0)))


def test_a_full_disk_ends_the_run_now(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the save, where the space is known to be short; in the save, where it runs out behind our back."""
    with Checkpointer(folder, CONFIG) as checkpoints:
        usage = shutil.disk_usage(folder)._replace(free=1000)
        with monkeypatch.context() as patch:
            patch.setattr(checkpointing.shutil, "disk_usage", lambda path: usage)
            with pytest.raises(CheckpointError, match=r"1,000 are free.*steps kept: 2, 3"):
                checkpoints.save(4, state(4))

        def fail(*_: Any) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(digests, "write", fail)
            with pytest.raises(CheckpointError, match=r"4: no space left"):
                checkpoints.save(4, state(4))
        assert checkpoints.latest_step() == 3


def test_two_writers_are_refused_and_a_killed_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "run.lock"
    code = (
        f"import sys, pathlib; sys.path.insert(0, {str(Path(__file__).parent.parent)!r})\n"
        "from ccil_jax import files\n"
        f"with files.hold(pathlib.Path({str(path)!r})): print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout and other.stdout.readline() == "held\n"
        with pytest.raises(LockedError, match=f"in use by process {other.pid} on "), files.hold(path):
            pass
        other.kill()
    with files.hold(path), pytest.raises(LockedError), files.hold(path):
        pass
