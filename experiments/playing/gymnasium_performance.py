"""Playing the policy of a run on an environment of Gymnasium: printed returns, and a film of its own pictures."""

import argparse
from collections.abc import Callable, Iterator

import numpy as np
from rich.console import Console

from experiments.commandline.arguments import UsageError
from experiments.playing import episodes, films, gymnasium_episodes
from experiments.playing.episodes import PlayedEpisode
from experiments.playing.film_formats import format_of
from experiments.running import progress
from sqt_jax.envs import host_rows
from sqt_jax.one_line import one_line
from sqt_jax.rollout import Policy
from sqt_jax.types import Environment


def perform(env: Environment, policy: Policy, options: argparse.Namespace, caption: str, console: Console) -> None:
    """Plays the episodes, prints their returns, and writes the film --video.

    Episode k starts with `reset(seed=start_seed + k)`, as in `sqt_jax.evaluate_policy`.

    Raises:
      UsageError: the environment fails, gives no pictures, or the film cannot be written.
    """
    assert env.host is not None
    played: list[PlayedEpisode] = []
    try:
        own = env.host.make(**{"render_mode": "rgb_array"} if options.video else {})
        limit = min(options.steps or env.episode_length, env.episode_length)
        with progress.counting("playing, steps", options.episodes * limit, console) as done:
            states = all_states(own, policy, options, limit, played.append, done)
            if options.video:
                film = write_film(own, states, options, caption)
            else:
                film = "--video=FILE writes a film"
                for _ in states:
                    pass
        host_rows.close(own)
    except UsageError:
        raise
    except Exception as error:  # of any type: it is the user's code
        raise UsageError(f"--env={env.name}: {one_line(error)}") from error
    for number, episode in enumerate(played):
        end = episodes.ending(episode)
        print(f"episode {number}: return {episode.total:,.1f}, {episode.length:,} steps, {end}", flush=True)
    print(film)


def all_states(
    own: object,
    policy: Policy,
    options: argparse.Namespace,
    limit: int,
    ended: Callable[[PlayedEpisode], None],
    done: Callable[[int], None],
) -> Iterator[int]:
    """The states of all episodes, one after another, as `gymnasium_episodes.play` yields them."""
    for number in range(options.episodes):
        for length in gymnasium_episodes.play(own, policy, options.start_seed + number, limit, ended):
            done(number * limit + length)
            yield length


def write_film(own: object, states: Iterator[int], options: argparse.Namespace, caption: str) -> str:
    """Writes the film of the states while they are played, in real time; returns a line about it."""
    path = options.video.absolute()  # the environment may change the current folder
    seconds = gymnasium_episodes.period(own)
    every = films.stride(seconds, format_of(path))
    size: list[tuple[int, ...]] = []

    def pictures() -> Iterator[np.ndarray]:
        for length in states:
            if length % every == 0:
                frame = gymnasium_episodes.picture(own)
                size.append(frame.shape)
                yield frame

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        written = films.write(path, pictures(), every * seconds, caption)
    except OSError as error:
        raise UsageError(
            f"--video={options.video}: expects a file that can be written: {error.strerror or error}"
        ) from None
    except ValueError as error:
        raise UsageError(f"--video={options.video}: {error}") from None
    height, width, _ = size[0]
    rate = 1 / (every * seconds)
    return f"{options.video}: {width}x{height}, {len(size):,} pictures, {rate:.4g} per second, {written / 1e6:,.2f} MB"
