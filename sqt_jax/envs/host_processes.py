"""Environments on the host in processes of their own, for slow ones: a step waits for the slowest process.

The processes are those of Gymnasium's `AsyncVectorEnv`
(https://gymnasium.farama.org/api/vector/async_vector_env/). What it takes for one environment is a `Group` of them.
"""

import multiprocessing
import os
import signal
import threading
import time
import warnings
from contextlib import suppress
from functools import partial
from multiprocessing import connection, forkserver, util
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from sqt_jax.envs.host_episodes import WorkerError, host_error
from sqt_jax.envs.host_rows import KEY_WORDS, LocalRows, Make, Steps

# A signal to the whole job reaches the workers too. The run saves, and then closes them.
IGNORED = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU]
SECONDS_TO_CLOSE = 5.0
ERROR = "error"  # the key of an exception in a group's `info`


class ProcessRows:
    """`Rows` shared by worker processes, each with a group of the environments.

    Args:
      make: makes one environment; is pickled.
      count: K.
      processes: the number of workers; no more than K are started.
      sizes: O and A.
    """

    def __init__(self, make: Make, count: int, processes: int, sizes: tuple[int, int]):
        self.counts = [len(group) for group in np.array_split(np.arange(count), min(processes, count))]
        size, own = self.counts[0], os.getpid()  # the first group is the largest
        self.words = 1 + KEY_WORDS + sizes[1]
        start_server()
        self.workers = AsyncVectorEnv(
            [partial(Group, make, sizes, count, size, own) for count in self.counts],
            context="forkserver",
            autoreset_mode=AutoresetMode.DISABLED,  # `LocalRows` starts the next episodes itself
        )
        # Before multiprocessing waits for its workers, which ignore the signal that it sends them.
        self.close = util.Finalize(self, _close, args=(self.workers,), exitpriority=100)

    def start(self, keys: np.ndarray) -> np.ndarray:
        """As in `Rows`."""
        return self._ask(_words(keys, None))

    def step(self, actions: np.ndarray, keys: np.ndarray) -> np.ndarray:
        """As in `Rows`."""
        return self._ask(_words(keys, actions))

    def _ask(self, words: np.ndarray) -> np.ndarray:
        padded = np.zeros((len(self.counts), self.counts[0], self.words), np.uint32)
        for group, rows in zip(padded, np.split(words, np.cumsum(self.counts)[:-1]), strict=True):
            group[: len(rows), : rows.shape[1]] = rows
        try:
            packed, *_, info = self.workers.step(padded)
        except (EOFError, OSError):
            ended = connection.wait([worker.sentinel for worker in self.workers.processes], timeout=5)
            codes = [worker.exitcode for worker in self.workers.processes if worker.sentinel in ended]
            raise RuntimeError(f"a worker process ended by itself (exit codes: {codes or 'unknown'})") from None
        if ERROR in info:
            raise WorkerError(next(error for error in info[ERROR] if error))
        return np.concatenate([rows[:count] for rows, count in zip(packed, self.counts, strict=True)])


class Group(gymnasium.Env):
    """`LocalRows` in a worker: its action is the words of a call, its observation the packed rows of the answer.

    Args:
      make: makes one environment.
      sizes: O and A.
      count: environments of this group.
      size: rows of the largest group; the others are padded.
      main_process: the number of the process that started the workers, in which a group stays empty.
    """

    def __init__(self, make: Make, sizes: tuple[int, int], count: int, size: int, main_process: int):
        self.in_worker = os.getpid() != main_process
        if self.in_worker:
            for number in IGNORED:
                signal.signal(number, signal.SIG_IGN)
            threading.Thread(target=_end_with_the_run, daemon=True).start()
        observation_size, action_size = sizes
        self.shape = size, Steps.packed_size(observation_size)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, self.shape, np.float32)
        self.action_space = gymnasium.spaces.Box(0, 2**32 - 1, (size, 1 + KEY_WORDS + action_size), np.uint32)
        self.rows = LocalRows(make, count)

    def step(self, words: Any) -> Any:
        """One call. `info` has its exception, if any: `AsyncVectorEnv` would print it and end the worker."""
        packed = np.zeros(self.shape, np.float32)
        words = words[: self.rows.count]
        keys = words[:, 1 : 1 + KEY_WORDS]
        info = {}
        try:
            if words[0, 0] == STARTS:
                packed[: len(words)] = self.rows.start(keys)
            else:
                actions = np.ascontiguousarray(words[:, 1 + KEY_WORDS :]).view(np.float32)
                packed[: len(words)] = self.rows.step(actions, keys)
        except BaseException as error:
            info[ERROR] = host_error(error)
        return packed, 0.0, False, False, info

    def close(self) -> None:
        """Closes the environments and ends the worker: nobody reads what it would print if the run was killed."""
        self.rows.close()
        if self.in_worker:
            os._exit(0)


def _end_with_the_run() -> None:
    """Ends this worker when its run has ended without closing it, even if an environment is waiting for ever."""
    run = multiprocessing.parent_process()
    assert run is not None
    run.join()
    time.sleep(SECONDS_TO_CLOSE)  # the worker sees the end itself, unless it is in a step, and closes its environments
    os._exit(1)


STARTS, STEPS = 0, 1  # the first word of a row


def _words(keys: np.ndarray, actions: np.ndarray | None) -> np.ndarray:
    """The words of a call [K, W]; without actions new episodes start."""
    first = np.full((len(keys), 1), STARTS if actions is None else STEPS, np.uint32)
    bits = [] if actions is None else [np.ascontiguousarray(actions, np.float32).view(np.uint32)]
    return np.concatenate([first, keys, *bits], axis=1)


def start_server() -> None:
    """Starts the process from which workers are forked, with the signals ignored that a whole job may get.

    It imports this module once for all workers.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload([__name__])
    if threading.current_thread() is not threading.main_thread():  # only the main thread may change signals
        return forkserver.ensure_running()
    before = {number: signal.signal(number, signal.SIG_IGN) for number in IGNORED}
    try:
        forkserver.ensure_running()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _close(workers: AsyncVectorEnv) -> None:
    def kill() -> None:
        for worker in workers.processes:
            worker.kill()

    timer = threading.Timer(SECONDS_TO_CLOSE, kill)
    timer.start()
    with suppress(Exception), warnings.catch_warnings():  # of a worker that has ended, or that is killed now
        warnings.simplefilter("ignore")
        workers.close()
    timer.cancel()
    workers.closed = True  # else it tries again when it is collected
    kill()
    for worker in workers.processes:
        worker.join()
