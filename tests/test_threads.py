"""The pool of threads that steps robots."""

import itertools
import os
import signal
import threading
import time

import pytest

from sqt_jax.envs.physics.threads import thread_pool


def numbered(work):
    """`work(number)` as a function for `run`; the caller's own number is 0."""
    helpers = itertools.count(1)
    return lambda: work(0 if threading.current_thread() is threading.main_thread() else next(helpers))


def test_an_interrupt_waits_for_the_threads():
    """Ctrl-C while the helpers still work is raised after they have ended."""
    ended = []

    def work(number):
        time.sleep(0.02 if number == 0 else 0.3)
        ended.append(number)

    def interrupt(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.1)
    try:
        with pytest.raises(KeyboardInterrupt):
            thread_pool(3).run(numbered(work), 3)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert sorted(ended) == [0, 1, 2]


@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_forked_child_has_threads_of_its_own():
    thread_pool(3).run(lambda: None, 3)
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # otherwise a child that waits for its parent's threads would wait forever
        seen = []
        thread_pool(3).run(numbered(seen.append), 3)
        os._exit(0 if sorted(seen) == [0, 1, 2] else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_an_error_in_a_thread_is_raised_once_all_have_ended():
    ended = []

    def work(number):
        if number == 1:
            raise RuntimeError("broken")
        ended.append(number)

    pool = thread_pool(3)
    with pytest.raises(RuntimeError, match="broken"):
        pool.run(numbered(work), 3)
    assert sorted(ended) == [0, 2]
    pool.run(numbered(ended.append), 3)  # the threads still work
    assert sorted(ended) == [0, 0, 1, 2, 2]
