"""Streams that drop what cannot be written (in whole commands: test_surroundings.py)."""

import os
import threading

from experiments.surroundings.streams import _Lenient


def test_output_to_a_full_disk_is_dropped():
    descriptor = os.open("/dev/full", os.O_WRONLY)
    assert _Lenient(descriptor, "w").write(b"1234") == 4


def test_output_to_a_closed_pipe_is_dropped():
    reader, writer = os.pipe()
    os.close(reader)
    assert _Lenient(writer, "w").write(b"1234") == 4


def test_all_output_to_a_slow_reader_arrives():
    """The pipe does not block, and holds less than what is written."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    content, received = b"x" * 200_000, []

    def read():
        while piece := os.read(reader, 10_000):
            received.append(piece)

    thread = threading.Thread(target=read)
    thread.start()
    with _Lenient(writer, "w") as file:
        left = memoryview(content)
        while left:
            left = left[file.write(left) :]
    thread.join()
    assert b"".join(received) == content
