"""Commands in processes that are forked from one, which has imported the large packages once.

For tests that start a command many times to see a refusal or `--help`. A command's process has the environment and the
streams of any other, but not a start of its own: tests of what Python or JAX reads at their start need
`subprocess.run`.
"""

import contextlib
import gc
import json
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


class ForkedCommands:
    """A process that forks one process for each command; a context."""

    def __enter__(self):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self._server = subprocess.Popen([sys.executable, __file__], cwd=ROOT, text=True, **pipes)
        return self

    def __exit__(self, *_):
        self._server.communicate()

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """`python -m experiments.<words>` in the folder of the repository."""
        with tempfile.TemporaryDirectory() as folder:
            self._server.stdin.write(json.dumps([folder, words]) + "\n")
            self._server.stdin.flush()
            code = int(self._server.stdout.readline())
            return subprocess.CompletedProcess(words, code, *((Path(folder) / name).read_text() for name in STREAMS))


STREAMS = ("stdout", "stderr")


def serve():
    """Answers each line of stdin, a command, by its exit code; its output is in files of the folder it names."""
    for line in sys.stdin:
        folder, words = json.loads(line)
        child = os.fork()
        if not child:
            return become(Path(folder), words)  # out of the loop: the process ends as any other
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def become(folder, words):
    """Runs a command in this process, whose streams are now files."""
    signal.alarm(120)  # seconds: one that hangs ends with the code -14
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for descriptor, name in enumerate(STREAMS, start=1):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT), descriptor)
    command, *sys.argv[1:] = words
    runpy.run_module(f"experiments.{command}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    sys.path[0] = str(ROOT)  # as `python -m` does
    with contextlib.redirect_stdout(None):  # answers only
        # None starts a backend of JAX, which could not be forked, or defines flags, which a command does itself.
        import mujoco  # noqa: F401
        import rich.console  # noqa: F401
        import tensorboardX  # noqa: F401

        import sqt_jax.experiment  # noqa: F401
    gc.freeze()  # a command that ends does not walk through all that was imported here
    serve()
