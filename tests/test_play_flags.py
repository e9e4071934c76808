"""The flags of the command that plays a policy are checked without JAX and MuJoCo."""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.commandline.arguments import UsageError
from experiments.playing import graphics, play_flags

ROOT = Path(__file__).resolve().parent.parent


def test_sizes():
    assert play_flags.size("640x480") == play_flags.size("640X480") == (640, 480)
    for text in ("640", "641x480", "0x2", "4098x16", "axb", "1x2x3"):
        with pytest.raises(argparse.ArgumentTypeError, match="expects "):
            play_flags.size(text)


@pytest.mark.parametrize("flags", [["--video=film.avi"], ["--size=64x48"], ["--vidio=film.mp4"]])
def test_a_typing_error_is_answered_without_jax_and_mujoco(tmp_path, flags):
    code = (
        "import sys; from experiments.play import main; code = main(sys.argv);"
        "assert not {'mujoco', 'jax', 'PIL', 'numpy'} & {*sys.modules}; sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path), *flags], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.startswith(flags[0].split("=")[0]), done.stderr


def options(folder, *flags):
    return play_flags.parser().read(["play", str(folder), *flags])


@pytest.mark.parametrize("before", ["other", None])
@pytest.mark.parametrize(
    ("env", "display", "flags", "value"),
    [
        ("ant", True, [], ""),
        ("ant", False, [], "disable"),
        ("brax:ant", False, ["--video=film.html"], "disable"),  # Brax's viewer
        ("ant", False, ["--video=film.html"], "osmesa"),
    ],
)
def test_mujoco_gl_is_set_while_mujoco_is_imported(tmp_path, monkeypatch, env, display, flags, value, before):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if before:
        monkeypatch.setenv("MUJOCO_GL", before)
    monkeypatch.setattr(graphics, "choose", lambda: "osmesa")
    monkeypatch.setattr(graphics, "has_display", lambda: display)
    (tmp_path / "config.json").write_text(json.dumps({"settings": {"env": env}}))
    with play_flags.chosen_graphics(tmp_path, options(tmp_path, *flags)):
        assert os.environ["MUJOCO_GL"] == value
    assert os.environ.get("MUJOCO_GL") == before


def test_a_damaged_config_is_left_to_the_reader_of_runs(tmp_path):
    for text in ("", "[]", '{"settings": {}}'):
        (tmp_path / "config.json").write_text(text)
        play_flags.check(tmp_path, options(tmp_path, f"--video={tmp_path / 'film.mp4'}"))
    with pytest.raises(UsageError, match="there is no such folder"):
        play_flags.check(tmp_path / "none", options(tmp_path / "none"))
