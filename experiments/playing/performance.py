"""Playing the policy of a run: episodes, their printed returns, and a film or MuJoCo's viewer."""

import argparse
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from experiments.commandline.arguments import UsageError
from experiments.playing import (
    brax_pages,
    episodes,
    films,
    graphics,
    gymnasium_performance,
    policies,
    rendering,
    viewer,
)
from experiments.playing.episodes import PlayedEpisode
from experiments.playing.play_flags import is_brax
from experiments.playing.played_task import PlayedTask, make_played_task
from experiments.running import files, progress
from experiments.surroundings import consoles, jax_settings
from sqt_jax.rollout import Policy

SIZE = (640, 480)


@jax_settings.needed_switches()
def perform(run: Path, options: argparse.Namespace) -> None:
    """Plays episodes of one member, prints their returns, and films or shows them.

    The returns are those of `sqt_jax.evaluate_policy` with `seed=start_seed`.

    Args:
      run: the folder of a run.
      options: checked flags of `play_flags.parser`.

    Raises:
      UsageError: no run or no policy, a flag that does not apply to it, or a film that cannot be written.
    """
    jax_settings.prepare()
    described = policies.read(run)
    best = options.policy == "best"
    returns = policies.member_returns(run, len(described.members), best)
    at = "by its best evaluation" if best else "at the last evaluation"
    chosen = policies.choose(described, returns, options.seed, options.member, at)
    task = make_played_task(chosen.member.config, options.physics, options.camera, options.env)
    loaded = policies.load(run, chosen, task.env, best)
    caption = policies.caption(described, chosen)
    print(caption)
    print(f"physics {task.physics}, start seed {options.start_seed}, policy: {loaded.origin}", flush=True)
    console = consoles.console(stderr=True)
    if task.env.host:
        gymnasium_performance.perform(task.env, loaded.policy, options, caption, console)
        return
    if task.scene is None and options.video:
        raise UsageError(f"--video: {task.env.name} is your own environment in JAX, which cannot be filmed")
    played = play_episodes(task, loaded.policy, options, console)
    for number, episode in enumerate(played):
        seconds = "" if math.isnan(task.period) else f", {episode.length * task.period:.1f} s"
        length = f"{episode.length:,} steps{seconds}"
        print(f"episode {number}: return {episode.total:,.1f}, {length}, {episodes.ending(episode)}", flush=True)
    if options.video:
        film_episodes(task, played, options, caption, console)
    elif task.scene is None:
        return
    elif is_brax(task.env.name):
        print("--video=FILE.html writes a film")
    elif not (graphics.has_display() and graphics.works("glfw")):
        print("no display here: --video=FILE writes a film")
    else:
        show_episodes(task, played, options.camera)


def play_episodes(
    task: PlayedTask, policy: Policy, options: argparse.Namespace, console: Console
) -> list[PlayedEpisode]:
    """Plays all episodes in parallel, with their progress on the console."""
    key = jax.random.key(options.start_seed)
    limit = min(options.steps or task.env.episode_length, task.env.episode_length)
    if task.physics != "mujoco":  # mujoco compiles in a second or two
        console.print(f"compiling the episodes for {task.physics}", highlight=False)
    with progress.counting("playing, steps", limit, console) as watch:
        return episodes.play(task.env, policy, task.look, key, options.episodes, options.steps, watch)


def film_episodes(
    task: PlayedTask, played: Sequence[PlayedEpisode], options: argparse.Namespace, caption: str, console: Console
) -> None:
    """Writes the film --video of the episodes, one after another in real time, and prints a line about it.

    Raises:
      UsageError: the file cannot be written.
    """
    path: Path = options.video
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if is_brax(task.env.name):
            with files.atomic_file(path) as file:
                written = file.write(brax_pages.page(task.scene, [episode.shown for episode in played]))
            print(f"{path}: {written / 1e6:,.2f} MB, for a browser that may fetch Brax's viewer")
            return
        width, height = options.size or SIZE
        every = films.stride(task.period, films.format_of(path))
        shown = [qpos for episode in played for qpos in episode.shown[0][::every]]
        mean_return = sum(episode.total for episode in played) / len(played)
        with progress.counting("rendering, pictures", len(shown), console) as done:
            pictures = counted(rendering.frames(task.scene, shown, (width, height), options.camera), done)
            written = films.write(path, pictures, every * task.period, f"{caption}; return {mean_return:,.1f}")
    except OSError as error:
        raise UsageError(f"--video={path}: expects a file that can be written: {error.strerror or error}") from None
    states = "every state" if every == 1 else f"one state in {every}"
    rate = 1 / (every * task.period)
    print(
        f"{path}: {width}x{height}, {len(shown):,} pictures, {rate:.4g} per second ({states}), {written / 1e6:,.2f} MB"
    )


def show_episodes(task: PlayedTask, played: Sequence[PlayedEpisode], camera: str) -> None:
    """Shows the episodes in MuJoCo's viewer until it is closed.

    Raises:
      UsageError: a window cannot be opened.
    """
    try:
        viewer.show(task.scene, [episode.shown for episode in played], task.period, camera)
    except RuntimeError as error:
        raise UsageError(f"RUN: cannot be shown in MuJoCo's viewer ({error}); --video=FILE writes a film") from None


def counted(pictures: Iterable[np.ndarray], done: Callable[[int], None]) -> Iterator[np.ndarray]:
    """The same pictures; calls `done` with the number of each, from 1."""
    for number, picture in enumerate(pictures, 1):
        done(number)
        yield picture
