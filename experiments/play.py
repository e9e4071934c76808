"""The learned policy acting: `python -m experiments.play RUN --video=film.mp4`.

Exit codes: 0 done; 2 bad usage (one line, nothing written); 130 interrupted.
"""

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from experiments.commandline import arguments
from experiments.commandline.arguments import Parser, UsageError, between, guarded
from experiments.playing import films, graphics
from experiments.running import files

# All that brings MuJoCo is imported after the way to render has been chosen, and all that brings JAX after what can be
# refused without it.
if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

    from experiments.playing.episodes import Episode
    from sqt_jax.types import Environment, TimeStep

EXAMPLE = "python -m experiments.play RUN --video=film.mp4"
DESCRIPTION = """\
The policy that a run has learned, acting: prints the return of each episode, and films it. Without --video it is shown
in MuJoCo's viewer where there is a display. The film shows the very episodes whose returns are printed, in real time.
Of a run's members the best at its last evaluation is played, unless --seed or --member asks for another. OpenGL without
a display: MUJOCO_GL, or else EGL or OSMesa, whichever works."""
INTERRUPTED = 130
MAX_SEED = 2**32 - 1
MAX_BYTES = 10_000_000  # of config.json
BRAX = "brax:"
SIZE = (640, 480)


class Task(NamedTuple):
    """An environment to play in, and what showing it expects."""

    env: "Environment"
    physics: str
    period: float  # seconds of a control step
    look: Callable[["TimeStep"], Any]  # what is kept of a state: see `episodes.play`
    scene: Any  # a mujoco.MjModel; of brax:ENV Brax's own environment


def size(text: str) -> tuple[int, int]:
    """The type of --size. Even numbers, as video formats want them."""
    numbers = text.lower().split("x")
    if len(numbers) != 2 or not all(n.isascii() and n.isdecimal() and len(n) < 6 for n in numbers):
        raise argparse.ArgumentTypeError(f"expects WIDTHxHEIGHT, not {text[:50]!r}")
    width, height = map(int, numbers)
    if not all(16 <= n <= 4096 and n % 2 == 0 for n in (width, height)):
        raise argparse.ArgumentTypeError(f"expects even numbers from 16 to 4096, not {text!r}")
    return width, height


def film(text: str) -> Path:
    """The type of --video."""
    try:
        if "\0" in text:
            raise ValueError("expects a file")
        films.format_of(Path(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{error}, not {text[:200]!r}") from None
    return Path(text)


def parser() -> Parser:
    made = Parser(DESCRIPTION, EXAMPLE, one=True)
    add = made.add_argument
    add("--seed", type=between(0, MAX_SEED), metavar="N", help="the member with this seed (of several the best)")
    add("--member", type=between(0, 1_000_000), metavar="N", help="the member with this number, from 0")
    add("--episodes", type=between(1, 1000), default=1, metavar="N", help="how many, one after another (1)")
    add("--steps", type=between(1, 1_000_000), metavar="N", help="of an episode at most (as long as the task has them)")
    add(
        "--start_seed",
        type=between(0, MAX_SEED),
        default=0,
        metavar="N",
        help="of the random starts, as `seed` of sqt_jax.evaluate_policy (0)",
    )
    add("--physics", metavar="NAME", help="what computes the episodes (mujoco; of brax:ENV what the run trained on)")
    add("--video", type=film, metavar="FILE", help="film.mp4, .gif or .html to write; of brax:ENV .html alone")
    add("--size", type=size, metavar="WIDTHxHEIGHT", help="of the film, in pixels (640x480)")
    add("--camera", default="", metavar="NAME", help="one of the model's (the one that follows the robot)")
    add("--overwrite", action="store_true", help="replace a film that is there")
    return made


def command(argv: Sequence[str]) -> None:
    options = parser().read(argv)
    path = Path(options.runs[0])
    _prepare(path, options)
    from rich.console import Console

    from experiments.running import runtime

    runtime.prepare()
    from experiments.playing import episodes, policies

    run = policies.read(path)
    chosen = policies.choose(run, policies.final_returns(path, len(run.members)), options.seed, options.member)
    task = _task(chosen.member.config, options)
    policy = policies.load(path, chosen, task.env)
    print(policies.told(run, chosen))
    print(f"physics {task.physics}, start seed {options.start_seed}", flush=True)
    console = Console(stderr=True)
    played = _play(task, policy, options, console)
    for number, episode in enumerate(played):
        lasting = f"{episode.length:,} steps, {episode.length * task.period:.1f} s"
        print(f"episode {number}: return {episode.total:,.1f}, {lasting}, {episodes.ending(episode)}", flush=True)
    if options.video:
        _film(task, played, options, policies.told(run, chosen), console)
    elif task.env.name.startswith(BRAX):
        print("--video=FILE.html films it")
    elif not (graphics.has_display() and graphics.works("glfw")):
        print("no display here: --video=FILE films it")
    else:
        from experiments.playing import viewer

        try:
            viewer.show(task.scene, [episode.shown for episode in played], task.period, options.camera)
        except RuntimeError as error:
            raise UsageError(f"RUN: cannot be shown in MuJoCo's viewer ({error}); --video=FILE films it") from None


def _prepare(path: Path, options: argparse.Namespace) -> None:
    """Refuses what can be told without JAX, and chooses how MuJoCo renders, before anything imports it."""
    if not path.is_dir():
        raise UsageError(f"{path}: there is no such folder")
    if options.video is None:
        for flag, given in {"--size": options.size, "--overwrite": options.overwrite}.items():
            if given:
                raise UsageError(f"{flag}: has no effect without --video")
        return
    arguments.reject_file("--video", options.video, options.overwrite)
    name = _env_name(path)
    if name.startswith(BRAX):
        if films.format_of(options.video) != "html":
            raise UsageError(f"--video={options.video}: expects a file with the ending .html, as {name} is Brax's")
        if options.size:
            raise UsageError(f"--size: Brax's viewer has its own; expects no size with {name}")
        return
    try:
        os.environ["MUJOCO_GL"] = graphics.choose()
    except graphics.NoGraphics as error:
        raise UsageError(f"--video={options.video}: {error}") from None


def _env_name(path: Path) -> str:
    """The environment of a run, as config.json has it; empty where that is for `policies.read` to refuse."""
    try:
        return str(files.read_json(path / "config.json", MAX_BYTES)["settings"]["env"])
    except (OSError, ValueError, TypeError, KeyError):
        return ""


def _task(config: Any, options: argparse.Namespace) -> Task:
    """What the member's run trained on, on the physics that is asked for. Raises `UsageError` where it cannot be."""
    from experiments.playing import brax_pages, episodes, rendering
    from sqt_jax import envs
    from sqt_jax.envs import brax_envs, gym_tasks

    brax = config.env.startswith(BRAX)
    physics = options.physics or (config.physics if brax else "mujoco")
    if physics not in envs.simulators(config.env):
        raise UsageError(f"--physics={physics}: expects one of {', '.join(envs.simulators(config.env))}")
    if missing := envs.lacks(physics):
        raise UsageError(f"--physics={physics}: needs {missing}")
    if brax:
        if options.camera:
            raise UsageError(
                f"--camera={options.camera}: Brax's viewer has its own; expects no camera with {config.env}"
            )
        own = brax_envs.brax_own(config.env, physics)
        return Task(envs.make(config.env, physics), physics, float(own.dt), brax_pages.poses, own)
    row = envs.TASKS[config.env]
    model = gym_tasks.load_model(row)
    try:
        rendering.view_of(model, options.camera)
    except ValueError as error:
        raise UsageError(f"--camera={options.camera}: {error}") from None
    env = envs.make(config.env, physics)
    return Task(env, physics, model.opt.timestep * row.frame_skip, episodes.configuration, model)


def _play(task: Task, policy: Callable, options: argparse.Namespace, console: "Console") -> "list[Episode]":
    import jax

    from experiments.playing import episodes
    from experiments.running import progress

    key = jax.random.key(options.start_seed)
    most = min(options.steps or task.env.episode_length, task.env.episode_length)
    if task.physics != "mujoco":  # which compiles in a second or two
        console.print(f"compiling the episodes for {task.physics}", highlight=False)
    with progress.counting("playing, steps", most, console) as watch:
        return episodes.play(task.env, policy, task.look, key, options.episodes, options.steps, watch)


def _film(
    task: Task, played: "Sequence[Episode]", options: argparse.Namespace, caption: str, console: "Console"
) -> None:
    from experiments.playing import brax_pages, rendering
    from experiments.running import progress

    path: Path = options.video
    width, height = options.size or SIZE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if task.env.name.startswith(BRAX):
            with files.atomic_file(path) as file:
                written = file.write(brax_pages.page(task.scene, [episode.shown for episode in played]))
            print(f"{path}: {written / 1e6:,.2f} MB, for a browser that may fetch Brax's viewer")
            return
        every = films.stride(task.period, films.format_of(path))
        shown = [qpos for episode in played for qpos in episode.shown[0][::every]]
        total = sum(episode.total for episode in played) / len(played)
        caption = f"{caption}; return {total:,.1f}"
        with progress.counting("rendering, pictures", len(shown), console) as done:
            pictures = _counted(rendering.frames(task.scene, shown, (width, height), options.camera), done)
            written = films.write(path, pictures, every * task.period, caption)
    except OSError as error:
        raise UsageError(f"--video={path}: expects a file that can be written: {error.strerror or error}") from None
    of = "every state" if every == 1 else f"one state in {every}"
    rate = 1 / (every * task.period)
    print(f"{path}: {width}x{height}, {len(shown):,} pictures, {rate:.4g} per second ({of}), {written / 1e6:,.2f} MB")


def _counted(pictures: Iterable["np.ndarray"], done: Callable[[int], None]) -> Iterator["np.ndarray"]:
    for number, picture in enumerate(pictures, 1):
        done(number)
        yield picture


def main(argv: Sequence[str]) -> int:
    """The command line `argv`, program name first; gives the exit code."""
    try:
        return guarded(command, argv)
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main(sys.argv))
