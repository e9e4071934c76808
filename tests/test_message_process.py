"""A process that talks by JSON lines."""

import queue
import sys
import time

import pytest

from experiments.launchers.message_process import MessageProcess

ECHO = "import sys, json\nfor line in sys.stdin: print(line.upper(), end='', flush=True)"


def python(script, **options):
    return MessageProcess([sys.executable, "-c", script], {"WORD": "yes"}, **options)


def test_messages_go_there_and_back():
    with python(ECHO) as process:
        process.send(a=1)
        process.send(b=["x"])
        assert process.receive(60) == {"A": 1} and process.receive(60) == {"B": ["X"]}
        with pytest.raises(queue.Empty):
            process.receive(0)
    assert process._process.returncode == 0  # it ended with its input
    assert process.receive(60) is None


@pytest.mark.parametrize(
    ("script", "text"),
    [
        ("", "its process was killed"),
        ("import sys; sys.exit('first\\n[2026-11-29 E 7 8] rpc.h:204: No answer. See a page.\\n')", "No answer"),
        ("import os; raise ValueError(os.environ['WORD'] + '\\033')", "ValueError: yes\\x1b"),
    ],
)
def test_why_it_ended(script, text):
    with python(script) as process:
        assert process.receive(60) is None
        process.send(a=1)  # no error
        assert process.last_error() == text


def test_it_has_its_own_session_and_is_killed_if_it_does_not_end():
    script = "import os, time; print(os.getsid(0) == os.getpid() and 1, flush=True); time.sleep(600)"
    began = time.monotonic()
    with python(script, leave_seconds=0.1) as process:
        assert process.receive(60) == 1
    assert process._process.returncode == -9 and time.monotonic() - began < 60
