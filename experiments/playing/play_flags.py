"""The command line of `experiments.play`, and the checks that need neither JAX nor MuJoCo."""

import argparse
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from experiments.commandline import arguments
from experiments.commandline.arguments import Parser, UsageError, between, one_of
from experiments.playing import graphics
from experiments.playing.film_formats import format_of
from experiments.running import files

EXAMPLE = "python -m experiments.play RUN --video=film.mp4"
DESCRIPTION = """\
Plays the policy of a run: prints the return of each episode, and films the same episodes in real time.
Without --video they are shown in MuJoCo's viewer if there is a display. Of a run's members, the best at the last
evaluation is played, unless --seed or --member names another. Before training has ended, the policy is that of the
newest checkpoint. Without a display, MUJOCO_GL selects OpenGL's implementation; by default EGL or OSMesa, whichever
works."""
MAX_SEED = 2**32 - 1
MAX_CONFIG_BYTES = 10_000_000
# Of modules that import JAX: `brax_envs.PREFIX`, and the physics `experiment.OWN_PHYSICS` and `gym_ids.PHYSICS`.
BRAX, OWN, HOST = "brax:", "own", "gymnasium"


def parser() -> Parser:
    """The parser of the command line."""
    made = Parser(DESCRIPTION, EXAMPLE, one=True)
    add = made.add_argument
    add("--seed", type=between(0, MAX_SEED), metavar="N", help="play the member with this seed (the best of several)")
    add("--member", type=between(0, 1_000_000), metavar="N", help="play the member with this number, from 0")
    choices = "last, or best: that of the member's best evaluation (last)"
    add("--policy", type=one_of("last", "best"), default="last", metavar="WHICH", help=choices)
    add("--episodes", type=between(1, 1000), default=1, metavar="N", help="number of episodes (1)")
    add("--steps", type=between(1, 1_000_000), metavar="N", help="maximum steps of an episode (the task's time limit)")
    add("--start_seed", type=between(0, MAX_SEED), default=0, metavar="N", help="seed of the initial states (0)")
    imports = "of a run on MODULE:FUNCTION or gym:MODULE:ID, the same again: its module is imported"
    add("--env", metavar="NAME", help=imports)
    add("--physics", metavar="NAME", help="physics of the episodes (mujoco; for brax:ENV, playground:ENV the run's)")
    add("--video", type=film, metavar="FILE", help="write a film: .mp4, .gif or .html; for brax:ENV only .html")
    add("--size", type=size, metavar="WIDTHxHEIGHT", help="size of the film in pixels (640x480)")
    add("--camera", default="", metavar="NAME", help="one of the model's cameras (the one that follows the robot)")
    add("--overwrite", action="store_true", help="replace an existing film")
    return made


def size(text: str) -> tuple[int, int]:
    """The type of --size: width and height in pixels, even numbers because video formats need them."""
    numbers = text.lower().split("x")
    if len(numbers) != 2 or not all(n.isascii() and n.isdecimal() and len(n) < 6 for n in numbers):
        raise argparse.ArgumentTypeError(f"expects WIDTHxHEIGHT, not {text[:50]!r}")
    width, height = map(int, numbers)
    if not all(16 <= n <= 4096 and n % 2 == 0 for n in (width, height)):
        raise argparse.ArgumentTypeError(f"expects even numbers from 16 to 4096, not {text!r}")
    return width, height


def film(text: str) -> Path:
    """The type of --video: a file with the ending of a film's format."""
    try:
        if "\0" in text:
            raise ValueError("expects a file")
        format_of(Path(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{error}, not {text[:200]!r}") from None
    return Path(text)


def check(run: Path, options: argparse.Namespace) -> None:
    """Rejects flags that do not apply to the run in the folder `run`, or a film that could not be written later.

    Raises:
      UsageError: with one line that names the flag.
    """
    if not run.is_dir():
        raise UsageError(f"{run}: there is no such folder")
    physics, name = _setting(run, "physics"), _setting(run, "env")
    own, host = physics == OWN, physics == HOST
    if own and options.env is None:
        raise UsageError(
            f"{run}: expects --env=MODULE:FUNCTION, a function that returns its own environment; or in Python: "
            f"sqt_jax.load_policy({str(run)!r}) and sqt_jax.evaluate_policy(policy, env)"
        )
    if host and options.env is None and name.count(":") > 1:
        raise UsageError(f"{run}: expects --env={name} too, which imports a module")
    if host and options.env not in (None, name):
        raise UsageError(f"--env={options.env}: expects {name}, the run's environment")
    if not (own or host) and options.env is not None:
        raise UsageError(f"--env: expects a run on an environment of your own; {run} names its environment itself")
    for flag, given in {"--physics": options.physics, "--camera": options.camera, "--size": options.size}.items():
        if (own or host) and given:
            raise UsageError(f"{flag}: has no effect with {name}, which has its own")
    if options.video is None:
        for flag, given in {"--size": options.size, "--overwrite": options.overwrite}.items():
            if given:
                raise UsageError(f"{flag}: has no effect without --video")
        return
    arguments.reject_file("--video", options.video, options.overwrite)
    if is_brax(name):
        if format_of(options.video) != "html":
            raise UsageError(f"--video={options.video}: expects a file with the ending .html, as {name} is Brax's")
        if options.size:
            raise UsageError(f"--size: Brax's viewer has its own; expects no size with {name}")


@contextmanager
def chosen_graphics(run: Path, options: argparse.Namespace) -> Iterator[None]:
    """Sets MUJOCO_GL while MuJoCo is imported, which reads it then: an OpenGL that works for a film, or none.

    Without a film the user's value is not used: MuJoCo cannot be imported with one that does not work.

    Raises:
      UsageError: no OpenGL implementation works.
    """
    before = os.environ.get("MUJOCO_GL")
    if not graphics.has_display():  # SDL, with which many environments of Gymnasium draw, would look for one
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
    try:
        os.environ["MUJOCO_GL"] = _graphics(run, options)
        yield
    except graphics.NoGraphics as error:
        raise UsageError(f"--video={options.video}: {error}") from None
    finally:
        if before is None:
            os.environ.pop("MUJOCO_GL", None)
        else:
            os.environ["MUJOCO_GL"] = before


def _graphics(run: Path, options: argparse.Namespace) -> str:
    """A value of MUJOCO_GL; empty is MuJoCo's own choice."""
    if options.video is None or is_brax(_setting(run, "env")):
        return "" if graphics.has_display() else "disable"
    if _setting(run, "physics") in (OWN, HOST):  # which may draw without OpenGL
        with suppress(graphics.NoGraphics):
            return graphics.choose()
        return "disable"
    return graphics.choose()


def is_brax(name: str) -> bool:
    """Whether an environment's name is of one of Brax's own."""
    return name.startswith(BRAX)


def _setting(run: Path, name: str) -> str:
    """A setting in a run's config.json; empty if that cannot be read, which `policies.read` reports."""
    try:
        return str(files.read_json(run / "config.json", MAX_CONFIG_BYTES)["settings"][name])
    except (OSError, ValueError, TypeError, KeyError):
        return ""
