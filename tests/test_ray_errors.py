"""How a cell ended whose task has no result."""

import pytest

exceptions = pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'").exceptions

from experiments.commandline.arguments import FAILED, INTERRUPTED  # noqa: E402
from experiments.launchers.cell import Cell, Ended  # noqa: E402
from experiments.launchers.ray_errors import ClusterLost, ended_by, one_line  # noqa: E402

CELL = Cell("ant", "td3", None, ())
NODE = "Task failed because the node it was running on is dead or unavailable. Node IP: 10.0.0.7, node ID: 30."


@pytest.mark.parametrize(
    ("error", "code", "reason", "lost"),
    [
        (exceptions.TaskCancelledError(), INTERRUPTED, "not started", False),
        (exceptions.WorkerCrashedError(), FAILED, "its Ray worker died", True),
        (exceptions.NodeDiedError(NODE), FAILED, "its Ray node 10.0.0.7 is gone", True),
        (exceptions.NodeDiedError("away"), FAILED, "its Ray node is gone", True),
        (exceptions.OutOfMemoryError("full\n"), FAILED, "ended by Ray: the memory of its node is full", True),
        (exceptions.RpcError("no\n  answer"), FAILED, "no answer", True),
        (
            exceptions.RayTaskError("train", "Traceback\n  File\nOSError: full", OSError("full")),
            FAILED,
            "OSError: full",
            False,
        ),
    ],
)
def test_the_reason_and_whether_it_is_tried_again(error, code, reason, lost):
    assert ended_by(error, CELL) == Ended(CELL, code, reason, lost)


def test_a_task_that_was_cancelled_by_force_had_started():
    error = exceptions.TaskCancelledError()
    assert ended_by(error, CELL, forced=True) == Ended(CELL, FAILED, "killed", lost=True)


@pytest.mark.parametrize("error", [exceptions.LocalRayletDiedError(), exceptions.RaySystemError("GCS is gone")])
def test_without_a_cluster_no_task_is_tried_again(error):
    with pytest.raises(ClusterLost, match="raylet died|GCS is gone"):
        ended_by(error, CELL)


def test_a_message_is_one_printable_line_of_limited_length():
    assert one_line(ValueError("a\n\tb \x1b[1m")) == "a b \\x1b[1m"
    assert one_line(ValueError()) == "ValueError" and len(one_line(ValueError("x" * 1000))) == 300
