"""Brax's page holds the states that were played, in real time."""

import base64
import json
import re
import zlib

import numpy as np
import pytest
from brax.base import Transform
from made_runs import add_policies, write_run

from experiments.play import main
from experiments.playing import brax_pages
from sqt_jax import envs
from sqt_jax.envs import brax_envs

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Brax's own
NAME = "brax:inverted_pendulum"  # the smallest: it compiles in seconds


def states_in(page):
    """The system and the positions of its links [states, L, 3] in a page."""
    text = page.decode()
    assert "<html" in text and "viewer.js" in text and "height: 100vh;" in text
    (data,) = re.findall(r'"([A-Za-z0-9+/=]{1000,})"', text)
    system = json.loads(zlib.decompress(base64.b64decode(data)))
    return system, np.array([state["pos"] for state in system["states"]["x"]])


def test_a_page_holds_the_episodes_one_after_another():
    own = brax_envs.brax_own(NAME, "spring")
    links = own.sys.num_links()
    episodes = [
        Transform(pos=np.random.default_rng(count).normal(size=(count, links, 3)), rot=np.zeros((count, links, 4)))
        for count in (4, 3)
    ]
    system, positions = states_in(brax_pages.page(own, episodes))
    np.testing.assert_allclose(positions, np.concatenate([episode.pos for episode in episodes]))
    assert system["opt"]["timestep"] == pytest.approx(own.dt) and own.dt > own.sys.opt.timestep


@pytest.mark.slow
def test_a_run_on_brax_is_played(tmp_path, capsys):
    path = write_run(tmp_path, "td3", NAME, physics="spring", hidden=(8, 8))
    add_policies(path, envs.make(NAME, "spring"))
    argv = ["play", str(path), "--episodes=2", f"--video={tmp_path / 'film.html'}"]
    assert main([*argv, "--steps=5"]) == 0
    shown = capsys.readouterr().out
    lengths = [int(length) for length in re.findall(r", (\d+) steps, ", shown)]
    _, positions = states_in((tmp_path / "film.html").read_bytes())
    assert len(lengths) == 2 and len(positions) == sum(lengths) and not np.allclose(positions[0], positions[4])
    assert main([*argv[:2], "--steps=5"]) == 0
    assert capsys.readouterr().out.endswith("--video=FILE.html writes a film\n")
