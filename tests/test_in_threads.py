"""Calls with a time limit."""

import sys
import threading
import time

import pytest

from experiments.running.in_threads import in_threads


@pytest.mark.parametrize("threads", [1, 3, 10])
def test_results_are_in_the_order_of_the_items(threads):
    def slow_first(item):
        time.sleep(0.03 - item / 200)
        return item * 2

    assert in_threads(slow_first, range(5), threads, 10) == [0, 2, 4, 6, 8]


def test_no_items_are_no_results():
    assert in_threads(len, [], 4, 1) == []


def test_a_call_that_hangs_costs_the_limit_and_does_not_keep_the_process():
    began, gate, before = time.monotonic(), threading.Event(), set(threading.enumerate())
    with pytest.raises(TimeoutError, match=r"^no answer within 0\.1 seconds$"):
        in_threads(lambda _: gate.wait(), [0, 1], 2, 0.1)
    assert time.monotonic() - began < 5
    left = set(threading.enumerate()) - before
    assert len(left) == 2 and all(thread.daemon for thread in left)
    gate.set()


def test_the_first_error_is_raised_and_the_rest_is_left_out():
    called = []

    def fails_at_one(item):
        called.append(item)
        if item == 1:
            raise ValueError("one")

    with pytest.raises(ValueError, match="^one$"):
        in_threads(fails_at_one, range(5), 1, 10)
    assert called == [0, 1]


def test_an_exit_in_a_thread_is_an_error():
    with pytest.raises(RuntimeError, match="^exit 3$"):
        in_threads(sys.exit, [3], 1, 10)
