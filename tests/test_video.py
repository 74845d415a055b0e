"""Videos, read back by other programs; and what is refused before any episode is played."""

import importlib.util
import itertools
import json
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

import envs
from ccil_jax.acting import networks
from ccil_jax.acting.rollout import Actor
from ccil_jax.config import Config
from ccil_jax.demonstrations import npz
from experiments import evaluate
from experiments.cli import waiting
from experiments.cli.command_line import UsageError
from experiments.page import video
from experiments.policies import evaluating
from experiments.policies.numpy_policy import policies
from tests.films import make_film
from tests.probe_envs import Walk

RED = (0xD1, 0x49, 0x5B)


def read_gif(path: Path) -> tuple[list[np.ndarray], list[int]]:
    """Its frames and how many milliseconds each is shown."""
    frames, milliseconds = [], []
    with Image.open(path) as image:
        for i in range(image.n_frames):
            image.seek(i)
            frames.append(np.asarray(image.convert("RGB")))
            milliseconds.append(image.info["duration"])
    return frames, milliseconds


def has_red(frame: np.ndarray) -> bool:
    return bool((np.abs(frame.astype(int) - RED).max(axis=-1) < 12).any())


def test_a_gif_shows_every_frame_as_long_as_it_lasted(tmp_path: Path) -> None:
    counted: list[tuple[int, int]] = []
    video.write(tmp_path / "a.gif", make_film(), "bar", cost_limit=2.0, on_progress=lambda *n: counted.append(n))
    frames, milliseconds = read_gif(tmp_path / "a.gif")
    assert len(frames) == 6
    assert sum(milliseconds) == 5 * 32 + 1000
    assert [has_red(frame) for frame in frames] == [False, False, True, False, False, False]
    for before, after in itertools.pairwise(frames):
        assert (before != after).any()
    dark = [np.flatnonzero(frame[70:, 320, 0] < 60).mean() for frame in (frames[0], frames[5])]
    assert dark[0] - dark[1] == pytest.approx(0.5 * 320 / 4, abs=2)  # the bar rises by 0.5 m, 80 pixels each
    assert counted == [(i, 6) for i in range(1, 7)]
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]


def test_an_mp4_lasts_as_long_as_the_episode(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    long = make_film(20, view="arena", way=make_film(20).strokes.places[:, 1, :2])
    video.write(tmp_path / "a.mp4", long, "bar")
    count, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert seconds == pytest.approx(19 * 0.032 + 1, abs=0.05)
    command = [ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / "a.mp4"), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run(command, capture_output=True, check=True).stdout
    frames = np.frombuffer(decoded, np.uint8).reshape(count, 572, 480, 3)
    assert has_red(frames[2])
    assert not has_red(frames[0])
    assert np.abs(frames[0].astype(int) - frames[19]).max() > 100


def test_a_video_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.gif"
    path.write_bytes(b"old")

    def fail(done: int, total: int) -> None:
        raise OSError("no space")

    with pytest.raises(OSError, match="no space"):
        video.write(path, make_film(), "bar", on_progress=fail)
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


def test_what_cannot_be_written_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(evaluating, "play", lambda *_: pytest.fail("an episode is played"))
    monkeypatch.setattr(evaluating, "load_file", lambda *_: pytest.fail("a policy is loaded"))
    old = tmp_path / "old.gif"
    old.write_bytes(b"old")
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if "ffmpeg" in name else find_spec(name))
    for more, message in (
        (["--video", f"{tmp_path}/a.avi"], "a.avi: unknown kind of video; end its name with .gif or .mp4"),
        (["--video", f"{tmp_path}/a.mp4"], "needs the package imageio-ffmpeg; `pip install 'ccil_jax[video]'`, or"),
        (["--video", str(old)], "old.gif: exists; choose another name or add --overwrite"),
        (["--video", str(tmp_path)], "unknown kind of video"),
        (["--video", f"{tmp_path}/a.gif", "--seed-index", "7"], "--seed-index 7: there is no such seed; give one of 0"),
        (["--video", f"{tmp_path}/a.gif", "--simulator", "original"], "videos are made in ours"),
        (["--seed-index", "0"], "add --record FILE.npz, --export FILE.npz or --video FILE.gif"),
    ):
        with pytest.raises(SystemExit) as end:
            evaluate.main(["--policy", "Hopper", *more])
        assert end.value.code == 2
        assert message in capsys.readouterr().err
    message = (
        r"--video a\.mp4: task my_tasks:walk cannot be drawn, because it has no MuJoCo model; leave it out, or let"
    )
    with pytest.raises(UsageError, match=message):  # and nobody installs a package in vain
        evaluate.check_drawing(Path("a.mp4"), "my_tasks:walk", Walk())
    assert [path.name for path in tmp_path.iterdir()] == ["old.gif"]


def test_a_policy_of_a_file_is_filmed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of two seeds the one that is asked for, in a task with short episodes."""
    options = {"max_episode_steps": 12}
    env, config = envs.make("Swimmer", physics="native", **options), Config(method="trpo", hidden_sizes=(4,))
    params = jax.vmap(networks.policy_of(config, env).init)(jax.random.split(jax.random.key(0), 2))
    seeds = policies(config, Actor(policy_params=params, obs_statistics=None), env)
    arrays = [seed.arrays() | {"obs_clip": np.asarray(5.0)} for seed in seeds]
    training = {"task": "Swimmer", "method": "gail", "physics": "native", "env_options": options, "cost_limit": 3.5}
    levels = dict.fromkeys(("expert_return", "expert_cost", "expert_length"))
    facts = {"training": {**training, "seed_indices": [4, 7]}, "levels": levels, "activation": config.activation}
    stacked = {name: np.stack([own[name] for own in arrays]) for name in arrays[0]}
    npz.write(tmp_path / "policy.npz", {**stacked, "metadata": np.array(json.dumps(facts))})
    given = ["--policy", f"{tmp_path}/policy.npz", "--episodes", "2", "--seed-index", "7"]
    assert evaluate.main([*given, "--video", f"{tmp_path}/a.gif"]) == 0
    assert "a.gif" in capsys.readouterr().out
    frames, milliseconds = read_gif(tmp_path / "a.gif")
    assert len(frames) == 13
    assert sum(milliseconds) == 12 * 40 + 1000


def test_progress_is_said_line_by_line_where_there_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(waiting, "_SECONDS_BETWEEN_LINES", 0.0)
    with waiting.progress("[red]evaluating", "steps") as update:
        update(1000, 2000)
        update(2000, 2000)
    assert capsys.readouterr().err == "[red]evaluating: 1,000/2,000 steps\n[red]evaluating: 2,000/2,000 steps\n"
