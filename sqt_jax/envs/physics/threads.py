"""The threads on which `mujoco_c` steps robots on the host."""

import os
import queue
import threading
from collections.abc import Callable


class ThreadPool:
    """The calling thread and `num_threads - 1` waiting ones; one call at a time."""

    def __init__(self, num_threads: int):
        self.lock = threading.Lock()
        self.todo: list[queue.SimpleQueue] = [queue.SimpleQueue() for _ in range(num_threads - 1)]
        for number, todo in enumerate(self.todo, start=1):
            threading.Thread(target=_serve, args=(todo,), daemon=True, name=f"mujoco-{number}").start()

    def run(self, work: Callable[[], None], num_threads: int) -> None:
        """Run `work()` in this thread and in `num_threads - 1` others; when all have ended, raise the first error.

        An interrupt (Ctrl-C) also waits for them: they write to memory that the next call uses.
        """
        with self.lock:
            done: queue.SimpleQueue = queue.SimpleQueue()
            helpers = self.todo[: num_threads - 1]
            for todo in helpers:
                todo.put((work, done))
            errors = [_error_of(work)]
            running = len(helpers)
            while running:
                try:
                    errors.append(done.get())
                    running -= 1
                except BaseException as interrupt:
                    errors.append(interrupt)
        for error in errors:
            if error is not None:
                raise error


def _serve(todo: queue.SimpleQueue) -> None:
    while True:
        work, done = todo.get()
        done.put(_error_of(work))


def _error_of(work: Callable[[], None]) -> BaseException | None:
    try:
        work()
    except BaseException as error:
        return error
    return None


_pools: dict[tuple[int, int], ThreadPool] = {}
_pools_lock = threading.Lock()


def thread_pool(num_threads: int) -> ThreadPool:
    """This process's pool of `num_threads`, made on first use. A forked child makes its own: it has no threads yet."""
    key = (os.getpid(), num_threads)
    with _pools_lock:
        if key not in _pools:
            _pools[key] = ThreadPool(num_threads)
        return _pools[key]
