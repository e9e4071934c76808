"""A part of the benchmark as a process of its own, which prints its measurements as lines while it runs.

What breaks a process (a lost GPU, an option that XLA does not know, no end) breaks only its own part.
"""

import dataclasses
import json
import os
import re
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress

from experiments.benchmarks.kernels import Kind
from experiments.benchmarks.measurements import Failure, Measurement

MARK = "MEASURED "  # begins the line of a result; other lines are ignored


def line(found: Measurement | Failure) -> str:
    """A result as a line of text."""
    content = found._asdict() if isinstance(found, Failure) else dataclasses.asdict(found)
    return MARK + json.dumps(content)


def parsed(text: str) -> Measurement | Failure | None:
    """The inverse of `line`; None for another line."""
    if not text.startswith(MARK):
        return None
    content = json.loads(text.removeprefix(MARK))
    if "why" in content:
        return Failure(**content)
    if content["kinds"] is not None:
        content["kinds"] = tuple(Kind(*kind) for kind in content["kinds"])
    return Measurement(**content | {"rates": tuple(content["rates"])})


def results(
    command: Sequence[str], what: str, limit: float, environment: Mapping[str, str]
) -> Iterator[Measurement | Failure]:
    """The results of a process, as they come; a `Failure` at the end if it fails or does not end in time.

    Args:
      what: the part's name in the failure.
      limit: seconds until the process is killed, with those that it started.
    """
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment, start_new_session=True
        )
        overdue = threading.Event()

        def stop() -> None:
            with suppress(ProcessLookupError):  # it has just ended
                os.killpg(process.pid, signal.SIGKILL)

        def stop_late() -> None:
            overdue.set()
            stop()

        timer = threading.Timer(limit, stop_late)
        timer.start()
        try:
            assert process.stdout
            for text in process.stdout:
                if found := parsed(text):
                    yield found
            process.wait()
        finally:
            timer.cancel()
            if process.poll() is None:
                stop()
            process.wait()
            assert process.stdout
            process.stdout.close()
        if overdue.is_set():
            yield Failure(what, f"it had not ended after {limit:.0f} s")
        elif process.returncode:
            errors.seek(0)
            yield Failure(what, reason(errors.read(), process.returncode))


def output_of(command: Sequence[str], environment: Mapping[str, str] | None = None) -> str:
    """The last line that a process prints, "" if none. Raises `RuntimeError` with the `reason` if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise RuntimeError(reason(done.stderr, done.returncode))
    return (done.stdout.strip().splitlines() or [""])[-1]


def end_with_parent(seconds: float = 1.0) -> None:
    """Ends this process, and those that it started, soon after the one that called `results` has ended: even a killed
    benchmark leaves no process on the GPU.

    Args:
      seconds: between two looks.
    """
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(seconds)
        os.killpg(os.getpid(), signal.SIGKILL)  # `results` gave it a group of its own

    threading.Thread(target=watch, daemon=True).start()


def reason(errors: str, code: int) -> str:
    """Why a process failed, in one line: XLA's last fatal message, or else the last line of its errors."""
    lines = [text.strip() for text in errors.splitlines() if text.strip()]
    fatal = [text.partition("] ")[2] for text in lines if re.match(r"F\d{4} ", text)]
    by = f"signal {-code}" if code < 0 else f"exit code {code}"
    return ([*lines[-1:], *fatal[-1:]] or [f"{by}, without an error"])[-1][:300]
