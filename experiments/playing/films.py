"""Pictures as a film: MP4 (H.264), GIF, or a page of HTML that holds the MP4."""

import base64
import contextlib
import html
import io
import math
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image

from experiments.playing.film_formats import format_of
from experiments.running import files

MAX_RATE = 60  # pictures per second: screens show no more
# The delay between a GIF's pictures is a multiple of 1/100 s, and browsers slow down delays below 2/100 s.
GIF_UNIT, GIF_LEAST = Fraction(1, 100), 2
QUALITY = 18  # x264's rate factor: 0 is lossless, 23 its default; the loss is invisible up to about 18


def stride(period: float, name: str) -> int:
    """The N for a real-time film of format `name` that shows every N-th state; states are `period` seconds apart."""
    exact = _fraction(period)
    if name != "gif":
        return math.ceil(1 / (MAX_RATE * exact))
    least = math.ceil(GIF_LEAST * GIF_UNIT / exact)
    exact_delays = [k for k in range(least, 10 * least) if (k * exact / GIF_UNIT).denominator == 1]
    return next(iter(exact_delays), least)


def encode(frames: Iterable[np.ndarray], period: float, name: str, caption: str = "") -> bytes:
    """The bytes of a film.

    Args:
      frames: pictures [H, W, 3] uint8 of one size, H and W even.
      period: seconds that each is shown.
      name: one of `film_formats.FORMATS`.
      caption: shown on a page of HTML.

    Raises:
      ValueError: there are no pictures, or H or W is odd.
      OSError: the film cannot be encoded.
    """
    pictures = iter(frames)
    first = next(pictures, None)
    if first is None:
        raise ValueError("a film needs a picture")
    height, width, _ = first.shape
    if height % 2 or width % 2:
        raise ValueError(f"a film needs even numbers of pixels, not {width}x{height}")
    pictures = chain([first], pictures)
    if name == "gif":
        return _gif(pictures, period)
    film = _mp4(pictures, (width, height), period)
    return _page(film, (width, height), caption) if name == "html" else film


def write(path: Path, frames: Iterable[np.ndarray], period: float, caption: str = "") -> int:
    """Writes a film in the format of the file's ending, completely or not at all; returns its size in bytes.

    Raises as `encode`.
    """
    content = encode(frames, period, format_of(path), caption)
    with files.atomic_file(path) as file:
        return file.write(content)


def _mp4(frames: Iterable[np.ndarray], size: Sequence[int], period: float) -> bytes:
    try:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error"]
    except RuntimeError:
        raise OSError("imageio-ffmpeg has no ffmpeg for this machine") from None
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(1 / _fraction(period))]
    command += ["-i", "-", "-an", "-vcodec", "libx264", "-crf", str(QUALITY), "-pix_fmt", "yuv420p"]
    command += ["-movflags", "+faststart", "film.mp4"]  # the index first, so that a film plays while it loads
    with tempfile.TemporaryDirectory() as folder, Path(folder, "errors").open("wb") as errors:
        # Not imageio_ffmpeg.write_frames: it forks, which is unsafe with JAX's threads. A session of its own, so that
        # Ctrl-C reaches only this process.
        process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.PIPE, stdout=errors, stderr=errors, start_new_session=True
        )
        assert process.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError), process.stdin as pipe:  # if it has ended, see its exit code
                for frame in frames:
                    pipe.write(np.ascontiguousarray(frame, np.uint8).data)
        except BaseException:
            process.kill()
            raise
        finally:
            process.wait()
        if process.returncode:
            text = Path(folder, "errors").read_text(errors="replace")
            raise OSError(f"ffmpeg: {' '.join(text.split())[:300]}")
        return Path(folder, "film.mp4").read_bytes()


def _gif(frames: Iterable[np.ndarray], period: float) -> bytes:
    images = (Image.fromarray(frame) for frame in frames)
    stream = io.BytesIO()
    milliseconds = round(1000 * period)
    next(images).save(stream, "GIF", save_all=True, append_images=images, duration=milliseconds, loop=0)
    return stream.getvalue()


def _page(film: bytes, size: Sequence[int], caption: str) -> bytes:
    width, height = size
    text = html.escape(caption)
    data = base64.b64encode(film).decode("ascii")
    return f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>{text}</title>
<style>body {{ font-family: sans-serif; margin: 2em }} video {{ max-width: 100%; height: auto }}</style>
<video width="{width}" height="{height}" controls autoplay loop muted playsinline
 src="data:video/mp4;base64,{data}"></video>
<p>{text}</p>
</html>
""".encode()


def _fraction(period: float) -> Fraction:
    """The seconds as a simple fraction: 1/20, not the float next to it."""
    return Fraction(period).limit_denominator(1_000_000)
