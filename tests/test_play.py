"""The command that plays a policy: it prints the returns of an evaluation, and films the same episodes."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from made_runs import add_policies, write_run

import sqt_jax
from experiments import play
from experiments.playing import graphics, rendering, viewer
from sqt_jax import envs

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run of two seeds, 3 and 5, of which 5 is the better; one of Brax's; and a folder without a run."""
    folder = tmp_path_factory.mktemp("runs")
    path = write_run(folder, "td3", "hopper", [[0, 1], [0, 2]], seeds=(3, 5), hidden=(8, 8))
    add_policies(path, envs.make("hopper", "mujoco"), [1, 2])
    write_run(folder, "td3", "brax:inverted_pendulum", physics="spring", hidden=(8, 8))
    write_run(folder, "td3", "cheetah", sizes=(17, 6))  # an environment from Python with the name of a task
    (folder / "results").mkdir()
    (folder / "results" / "table.md").write_text("none")
    return folder


@pytest.fixture
def folder(made, tmp_path, monkeypatch):
    """The working directory, with the runs in it and without a display."""
    shutil.copytree(made, tmp_path / "runs")
    (tmp_path / "there.mp4").write_text("mine")
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


RUN = "runs/hopper/td3/run"
BRAX = "runs/brax:inverted_pendulum/td3/run"
OWN = "runs/cheetah/td3/run"
BY_PYTHON = (
    f"{OWN}: expects --env=MODULE:FUNCTION, a function that returns its own environment; or in Python: "
    f"sqt_jax.load_policy('{OWN}') and sqt_jax.evaluate_policy(policy, env)"
)


@pytest.fixture
def pictures(monkeypatch):
    """Rendering without OpenGL: the configurations that would be drawn, as blank pictures."""
    drawn = []

    def frames(model, configurations, size, camera):
        for qpos in configurations:
            drawn.append(qpos)
            yield np.full((size[1], size[0], 3), 100, np.uint8)

    monkeypatch.setattr(rendering, "frames", frames)
    monkeypatch.setattr(graphics, "choose", lambda: "glfw")
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    return drawn


def printed(text):
    """The returns and lengths of the lines of episodes."""
    rows = re.findall(r"episode \d+: return ([-\d.,]+), ([\d,]+) steps", text)
    return [float(total.replace(",", "")) for total, _ in rows], [int(length.replace(",", "")) for _, length in rows]


def test_the_returns_are_an_evaluations_and_the_film_is_of_those_episodes(folder, pictures, capsys):
    argv = ["play", RUN, "--episodes=3", "--start_seed=7", "--size=32x16", "--video=new/folder/film.mp4"]
    assert play.main(argv) == 0
    out, err = capsys.readouterr()
    assert out.startswith(
        "td3 on hopper: member 1, seed 5 (the best of 2 at the last evaluation)\n"
        "physics mujoco, start seed 7, policy: the last one\n"
    )
    policy = sqt_jax.load_policy(f"{RUN}/policy", member=1)
    returns, lengths = sqt_jax.evaluate_policy(policy, envs.make("hopper", "mujoco"), num_episodes=3, seed=7)
    totals, steps = printed(out)
    np.testing.assert_allclose(totals, returns, atol=0.051)
    assert steps == lengths.tolist() and out.count("terminated by the task") == 3
    # 8 ms a step: one state in three is 41.67 pictures a second
    count = sum(-(-length // 3) for length in steps)
    assert f"new/folder/film.mp4: 32x16, {count} pictures, 41.67 per second (one state in 3), 0.0" in out
    assert len(pictures) == count and pictures[0].shape == (6,) and (abs(pictures[0][2:]) < 0.006).all()
    frames, seconds = imageio_ffmpeg.count_frames_and_secs("new/folder/film.mp4")
    assert frames == count and seconds == pytest.approx(count * 0.024, abs=0.03)


def test_a_member_is_named_and_steps_are_limited(folder, capsys):
    """On a run that was killed: its policies are in a checkpoint."""
    (folder / RUN / "checkpoint" / "step_0000050000").mkdir(parents=True)
    (folder / RUN / "policy").rename(folder / RUN / "checkpoint" / "step_0000050000" / "policy")
    assert play.main(["play", RUN, "--seed=3", "--steps=4"]) == 0
    out = capsys.readouterr().out
    assert "policy: the last one, from the checkpoint at step 50,000\n" in out
    assert "member 0, seed 3 (of 2)" in out and "4 steps, 0.0 s, cut off" in out
    assert out.endswith("no display here: --video=FILE writes a film\n")


def test_where_there_is_a_display_mujocos_viewer_shows_it(folder, capsys, monkeypatch):
    shown = []

    def show(*arguments):
        shown.append(arguments)
        raise RuntimeError("not on this system")

    monkeypatch.setattr(graphics, "has_display", lambda: True)
    monkeypatch.setattr(graphics, "works", lambda name: name == "glfw")
    monkeypatch.setattr(viewer, "show", show)
    assert play.main(["play", RUN, "--steps=4", "--camera=track"]) == 2
    (_, ((qpos, qvel),), period, camera) = shown[0]
    assert (qpos.shape, qvel.shape, camera) == ((4, 6), (4, 6), "track") and period == pytest.approx(0.008)
    assert "cannot be shown in MuJoCo's viewer (not on this system); --video=FILE" in capsys.readouterr().err


REJECTED = [
    ("", "RUN: expects the folder of one run, as in"),
    (f"{RUN} {BRAX}", "RUN: expects the folder of one run, as in"),
    ("none", "none: there is no such folder"),
    ("there.mp4", "there.mp4: there is no such folder"),
    ("runs", "runs: expects the folder of a run; it has no config.json"),
    ("runs/results --video=film.mp4", "runs/results: expects the folder of a run; it has no config.json"),
    (f"{RUN} --seed=4", "--seed=4: expects a seed of the run, one of 3, 5"),
    (f"{RUN} --seed=-1", "--seed: expects a whole number from 0 to 4294967295, not '-1'"),
    (f"{RUN} --seed=" + "9" * 5000, "--seed: expects a whole number"),
    (f"{RUN} --member=2", "--member=2: expects one of the run's members, 0 to 1"),
    (f"{RUN} --seed=3 --member=1", "--seed=3: member 1 has seed 5"),
    (f"{RUN} --policy=first", "--policy: expects one of last, best, not 'first'"),
    (f"{RUN} --policy=best", f"{RUN}: expects a run with policy_best/, which is saved with each checkpoint"),
    (f"{RUN} --episodes=0", "--episodes: expects a whole number from 1 to 1000, not '0'"),
    (f"{RUN} --steps=many", "--steps: expects a whole number from 1"),
    (f"{RUN} --physics=mujco", "--physics=mujco: expects one of mjx, mujoco, warp"),
    (f"{RUN} --video=film.avi", "--video: expects a file with the ending .mp4, .gif, .html, not 'film.avi'"),
    (f"{RUN} --video=film", "--video: expects a file with the ending"),
    (f"{RUN} --video=", "--video: expects a file with the ending"),
    (f"{RUN} --video=a\0b.mp4", "--video: expects a file, not 'a\\x00b.mp4'"),
    (f"{RUN} --video=there.mp4", "--video=there.mp4: already exists; expects another file, or --overwrite"),
    (f"{RUN} --video=there.mp4/film.mp4", "--video=there.mp4/film.mp4: expects a file in a folder that can be written"),
    (f"{RUN} --size=640", "--size: expects WIDTHxHEIGHT, not '640'"),
    (f"{RUN} --size=641x480", "--size: expects even numbers from 16 to 4096, not '641x480'"),
    (f"{RUN} --size=0x99999", "--size: expects even numbers from 16 to 4096"),
    (f"{RUN} --size=64x48", "--size: has no effect without --video"),
    (f"{RUN} --overwrite", "--overwrite: has no effect without --video"),
    (f"{BRAX} --video=film.html --size=64x48", "--size: Brax's viewer has its own; expects no size with brax:"),
    (f"{RUN} --camera=side", "--camera=side: expects one of track, not 'side'"),
    (f"{RUN} --vidio=film.mp4", "--vidio: unknown flag; did you mean --video?"),
    (f"{BRAX} --video=film.mp4", "--video=film.mp4: expects a file with the ending .html, as brax:inverted_pendulum"),
    (f"{BRAX} --physics=mujoco", "--physics=mujoco: expects one of mjx, generalized, spring, positional"),
    (f"{BRAX} --camera=track", "--camera=track: Brax's viewer has its own"),
    (OWN, BY_PYTHON),
    (f"{OWN} --physics=mujoco --video=film.html", BY_PYTHON),
]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(("arguments", "says"), REJECTED, ids=[ascii(row[0])[1:60] for row in REJECTED])
def test_an_invalid_command_is_one_line_and_nothing_is_written(folder, pictures, capsys, arguments, says):
    before = sorted(folder.rglob("*"))
    assert play.main(["play", *(word for word in arguments.split(" ") if word)]) == 2
    out, err = capsys.readouterr()
    assert err.startswith(says) and err.count("\n") == 1 and err[:-1].isprintable() and not out
    assert sorted(folder.rglob("*")) == before and (folder / "there.mp4").read_text() == "mine"


def test_without_opengl_a_film_is_rejected_before_anything_is_played(folder, capsys, monkeypatch):
    def none():
        raise graphics.NoGraphics("no OpenGL works here")

    monkeypatch.setattr(graphics, "choose", none)
    assert play.main(["play", RUN, "--video=film.mp4"]) == 2
    assert capsys.readouterr() == ("", "--video=film.mp4: no OpenGL works here\n")
    assert not Path("film.mp4").exists()


def test_an_interrupt_prints_no_traceback(monkeypatch):
    def interrupted(argv):
        raise KeyboardInterrupt

    monkeypatch.setattr(play, "command", interrupted)
    assert play.main(["play", RUN]) == 130


def test_a_film_from_the_command_line(folder):
    try:
        graphics.choose()
    except graphics.NoGraphics as error:
        pytest.skip(str(error))
    command = [sys.executable, "-m", "experiments.play", str(folder / RUN), "--steps=10", "--size=64x48"]
    command += [f"--video={folder / 'there.mp4'}", "--overwrite"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, env=dict(os.environ))
    assert (done.returncode, done.stderr) == (0, "")
    assert "there.mp4: 64x48, 4 pictures" in done.stdout
    assert imageio_ffmpeg.count_frames_and_secs(folder / "there.mp4")[0] == 4
