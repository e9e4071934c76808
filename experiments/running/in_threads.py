"""Calls that may hang, in threads, with a time limit for all of them together."""

import queue
import threading
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(function: Callable[[Item], Result], items: Sequence[Item], threads: int, seconds: float) -> list[Result]:
    """The results of `function(item)` for each item, in order.

    A call that hangs is left alone: its thread is a daemon, which does not keep the process from ending.

    Args:
      threads: how many calls run at the same time.

    Raises:
      Exception: what a call raised, the first of them. Calls that have not begun are left out then.
      TimeoutError: not all have ended after `seconds`.
    """
    waiting: queue.SimpleQueue[tuple[int, Item]] = queue.SimpleQueue()
    for task in enumerate(items):
        waiting.put(task)
    results: dict[int, Result] = {}
    errors: list[Exception] = []
    end = time.monotonic() + seconds

    def work() -> None:
        while not errors and time.monotonic() < end:
            try:
                index, item = waiting.get_nowait()
            except queue.Empty:
                return
            try:
                results[index] = function(item)
            except Exception as error:
                errors.append(error)
            except SystemExit as error:  # Python ends a thread in silence then
                errors.append(RuntimeError(f"exit {error.code}"))

    workers = [threading.Thread(target=work, daemon=True) for _ in range(min(threads, len(items)))]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(max(0.0, end - time.monotonic()))
    if errors:
        raise errors[0]
    if len(results) < len(items):
        raise TimeoutError(f"no answer within {seconds:g} seconds")
    return [results[index] for index in range(len(items))]
