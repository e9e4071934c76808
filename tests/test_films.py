"""Films can be read back: as many pictures, as large, as fast as they should be."""

import base64
import io
import re
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from experiments.playing import films
from experiments.playing.film_formats import FORMATS
from sqt_jax.envs.gym_table import TASKS
from sqt_jax.envs.gym_tasks import load_model

HEIGHT, WIDTH = 34, 50  # even, and not multiples of 16, which encoders prefer
PERIODS = {load_model(task).opt.timestep * task.frame_skip for task in TASKS.values()}


def pictures(count=12):
    """A white bar that moves to the right, on a background whose colour changes."""
    for number in range(count):
        picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        picture[:] = 20 * number, 60, 200 - 10 * number
        picture[:, 4 * number : 4 * number + 4] = 255
        yield picture


def decoded(path):
    """ffmpeg's text about a film, and its pictures."""
    # not by imageio_ffmpeg.read_frames, which forks
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    (described,) = re.findall(r"Stream #0:0.*Video: (h264.*)", done.stderr.decode().partition("Output")[0])
    return described, list(np.frombuffer(done.stdout, np.uint8).reshape(-1, HEIGHT, WIDTH, 3))


def test_an_mp4_holds_the_pictures(tmp_path):
    path = tmp_path / "film.mp4"
    assert films.write(path, pictures(), 0.05) == path.stat().st_size
    assert [item.name for item in tmp_path.iterdir()] == ["film.mp4"]
    described, frames = decoded(path)
    assert all(piece in described for piece in ("yuv420p", f"{WIDTH}x{HEIGHT}", " 20 fps")) and len(frames) == 12
    assert imageio_ffmpeg.count_frames_and_secs(path) == (12, pytest.approx(0.6))
    for frame, picture in zip(frames, pictures(), strict=True):
        assert abs(frame.astype(int) - picture).mean() < 12  # colours are halved in resolution


def test_a_gif_holds_the_pictures():
    with Image.open(io.BytesIO(films.encode(pictures(), 0.04, "gif"))) as gif:
        assert (gif.n_frames, gif.size, gif.info["loop"]) == (12, (WIDTH, HEIGHT), 0)
        for number, picture in enumerate(pictures()):
            gif.seek(number)
            assert gif.info["duration"] == 40
            assert abs(np.asarray(gif.convert("RGB")).astype(int) - picture).mean() < 2


def test_a_page_holds_the_film(tmp_path):
    path = tmp_path / "film.HTML"
    films.write(path, pictures(), 0.05, caption="<return> 5 & more")
    text = path.read_text()
    assert text.count("&lt;return&gt; 5 &amp; more") == 2 and "<return>" not in text
    assert f'width="{WIDTH}" height="{HEIGHT}"' in text and "http" not in text
    (data,) = re.findall(r'src="data:video/mp4;base64,([^"]*)"', text)
    (tmp_path / "film.mp4").write_bytes(base64.b64decode(data))
    assert len(decoded(tmp_path / "film.mp4")[1]) == 12


@pytest.mark.parametrize("period", sorted(PERIODS))
def test_films_of_every_task_run_in_real_time(period):
    for name in FORMATS:
        every = films.stride(period, name)
        shown = every * period
        assert 1 / 61 < shown <= 0.05, "smooth, and no faster than screens"
        if name == "gif":
            assert shown >= 0.02 and shown * 100 == pytest.approx(round(shown * 100))
    assert films.stride(0.05, "mp4") == 1 and films.stride(0.008, "mp4") == 3 and films.stride(0.008, "gif") == 5


def test_strides_of_periods_without_an_exact_multiple():
    assert films.stride(1 / 30, "gif") == 3 and films.stride(1 / 64, "mp4") == 2
    assert films.stride(0.0123457, "gif") == 2  # nearly


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize(
    ("frames", "says"),
    [([], "needs a picture"), ([np.zeros((34, 51, 3), np.uint8)], "even numbers of pixels, not 51x34")],
)
def test_pictures_that_make_no_film_are_rejected(name, frames, says):
    with pytest.raises(ValueError, match=says):
        films.encode(frames, 0.05, name)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_an_unfinished_film_does_not_replace_the_old_one(tmp_path, suffix, error):
    path = tmp_path / f"film.{suffix}"
    path.write_text("old")

    def broken():
        yield from pictures(3)
        raise error

    with pytest.raises(error):
        films.write(path, broken(), 0.05)
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_ffmpegs_error_is_reported(monkeypatch):
    monkeypatch.setattr(films, "QUALITY", "nonsense")
    with pytest.raises(OSError, match="ffmpeg: .*nonsense"):
        films.encode(pictures(), 0.05, "mp4")


def test_a_missing_ffmpeg_is_reported(monkeypatch):
    def missing():
        raise RuntimeError

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", missing)
    with pytest.raises(OSError, match="no ffmpeg for this machine"):
        films.encode(pictures(), 0.05, "mp4")
