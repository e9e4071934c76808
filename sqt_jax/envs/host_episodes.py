"""The running episodes of one environment on the host: what the compiled program calls, on each device by itself.

Every call has a number, which the program passes on with the state. So a call that does not follow the one before is
found out, and a call that is made twice is answered twice, not played twice.
"""

import queue
import threading
import traceback
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from sqt_jax.envs.host_rows import KEY_WORDS, Rows, Steps
from sqt_jax.one_line import one_line
from sqt_jax.types import HostError

CALL_WORDS = 2  # of a row: the number of the call that made it, and its own number


class DeviceEpisodes:
    """The `Episodes` of each device: devices run at their own pace. All play in one thread, as some libraries need.

    Arguments as of `Episodes`.
    """

    def __init__(self, make_rows: Callable[[int], Rows], observation_size: int, action_size: int):
        self.observation_size = observation_size
        thread, self._lock = PlayingThread(), threading.Lock()
        weakref.finalize(self, thread.end).atexit = False  # the thread ends with the process
        self._make = lambda: Episodes(make_rows, observation_size, action_size, thread)
        self._devices: dict[int, Episodes] = {}
        self.out_words = self._make().out_words

    @property
    def error(self) -> HostError | None:
        """The exception of an environment; None: there was none."""
        return next((episodes.error for episodes in self._episodes() if episodes.error), None)

    def start(self, words: np.ndarray) -> np.ndarray:
        """As `Episodes.start`; the first word of each row is the number of the device."""
        return self._of(words).start(words[..., 1:])

    def step(self, words: np.ndarray) -> np.ndarray:
        """As `Episodes.step`; the first word as in `start`."""
        return self._of(words).step(words[..., 1:], playing=self.error is None)

    def close(self) -> None:
        """Closes the environments. Later episodes would make new ones."""
        for episodes in self._episodes():
            episodes.close()

    def _of(self, words: np.ndarray) -> "Episodes":
        device = int(words[(0,) * words.ndim])
        with self._lock:
            if device not in self._devices:
                self._devices[device] = self._make()
            return self._devices[device]

    def _episodes(self) -> list["Episodes"]:
        with self._lock:
            return [*self._devices.values()]


class Episodes:
    """Episodes in lockstep, one for each row of a call.

    Args:
      make_rows: K -> `Rows` of K environments. Called when the first episodes start, or when K changes.
      observation_size: O.
      action_size: A.
      thread: where they play.
    """

    def __init__(
        self, make_rows: Callable[[int], Rows], observation_size: int, action_size: int, thread: "PlayingThread"
    ):
        self.make_rows = make_rows
        self.observation_size, self.action_size = observation_size, action_size
        self.out_words = CALL_WORDS + 1 + Steps.packed_size(observation_size)
        self.rows: Rows | None = None
        self.count = 0  # K
        self.calls = 0
        self.error: HostError | None = None  # the first exception; from then on nothing is played
        self._last: tuple[bytes, np.ndarray] | None = None  # the last call's words, and its answer
        self._thread = thread

    def start(self, words: np.ndarray) -> np.ndarray:
        """New episodes in all rows: words of keys [..., 3] uint32 -> [..., call words, failed, packed row]."""
        rows = words.reshape(-1, KEY_WORDS)
        failed = self.error is not None  # then its environments, and their processes, may not be usable

        def play() -> np.ndarray:
            if self.rows is None or self.count != len(rows) or failed:
                self._close_rows()
                self.rows, self.count = self.make_rows(len(rows)), len(rows)
            return self.rows.start(rows)

        self.error = None
        return self._answer(play, len(rows)).reshape(*words.shape[:-1], -1)

    def step(self, words: np.ndarray, playing: bool = True) -> np.ndarray:
        """One step in all rows: [..., call words, key words, action bits] uint32 -> as `start`.

        Without `playing`, because another device's environment has failed, the answer says failed.
        """
        rows = words.reshape(-1, words.shape[-1])
        given = rows.tobytes()
        if self._last is not None and self._last[0] == given:
            return self._last[1].reshape(*words.shape[:-1], -1)

        def play() -> np.ndarray:
            calls, own = rows[:, 0], rows[:, 1]
            if len(rows) != self.count or (calls != self.calls).any() or (own != np.arange(self.count)).any():
                raise RuntimeError(
                    "a step does not follow the newest one: an environment on the host cannot go back, and plays one "
                    "batch of episodes at a time"
                )
            assert self.rows is not None
            keys = rows[:, CALL_WORDS : CALL_WORDS + KEY_WORDS]
            actions = np.ascontiguousarray(rows[:, CALL_WORDS + KEY_WORDS :]).view(np.float32)
            return self.rows.step(actions, keys)

        answer = self._answer(play if playing else None, len(rows))
        self._last = given, answer
        return answer.reshape(*words.shape[:-1], -1)

    def close(self) -> None:
        """Closes the environments. Later episodes would make new ones."""
        self._thread.run(self._close_rows)

    def _close_rows(self) -> None:
        rows, self.rows = self.rows, None
        if rows is not None:
            rows.close()

    def _answer(self, play: Callable[[], np.ndarray] | None, count: int) -> np.ndarray:
        """The words of a call's results [K, out_words]; placeholders once there is an error."""
        packed = None
        if self.error is None and play is not None:
            try:
                packed = self._thread.run(play)
            except BaseException as error:  # also SystemExit: it is the user's code
                self.error = host_error(error)
        self.calls = (self.calls + 1) % 2**32
        out = np.zeros((count, self.out_words), np.uint32)
        out[:, 0], out[:, 1] = self.calls, np.arange(count)
        if packed is None:
            packed = np.zeros((count, Steps.packed_size(self.observation_size)), np.float32)
            Steps.of(packed, self.observation_size).terminated[:] = 1
            out[:, CALL_WORDS] = 1
        out[:, CALL_WORDS + 1 :] = packed.view(np.uint32)
        return out


class WorkerError(Exception):
    """An exception of an environment in another process, as its `HostError`."""


class PlayingThread:
    """A thread that runs one function after another, until `end` or with the process."""

    def __init__(self) -> None:
        self.todo: queue.SimpleQueue = queue.SimpleQueue()
        threading.Thread(target=self._serve, daemon=True, name="host environments").start()

    def run(self, work: Callable[[], Any]) -> Any:
        """The result of `work()`, run in the thread; its exception is raised here."""
        done: queue.SimpleQueue = queue.SimpleQueue()  # its own: Ctrl-C may end the wait, and the next work follows
        self.todo.put((work, done))
        result, error = done.get()
        if error is not None:
            raise error
        return result

    def end(self) -> None:
        """Ends the thread after what it does now."""
        self.todo.put(None)

    def _serve(self) -> None:
        while (asked := self.todo.get()) is not None:
            work, done = asked
            try:
                done.put((work(), None))
            except BaseException as error:
                done.put((None, error))
            del asked, work  # they hold the episodes, which nobody else may need any more


def host_error(error: BaseException) -> HostError:
    """An exception as one line, and with its traceback."""
    if isinstance(error, WorkerError):
        return error.args[0]
    return HostError(one_line(error), "".join(traceback.format_exception(error)))
