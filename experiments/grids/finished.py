"""The results of finished runs, as their summary.json has them."""

import json
from typing import Any

from experiments.launchers.cell import Cell


def finished(cell: Cell) -> dict[str, Any] | None:
    """The content of summary.json if the cell's run has ended, else None; also where `scores` could not read it."""
    try:
        summary = json.loads((cell.path / "summary.json").read_text())
        if summary["status"] not in ("done", "diverged"):
            return None
        scores(summary)
        return summary
    except (OSError, ValueError, KeyError, TypeError):
        return None


def scores(summary: dict[str, Any] | None) -> str:
    """The scores in a run's summary.json, as text."""
    if summary is None:
        return "no summary"
    found = [group["score"] for group in summary["groups"]]
    parts = ["none" if s["mean"] is None else f"{s['mean']:,.0f} +- {s['std']:,.0f}" for s in found]
    lost = len(summary["diverged"])
    return f"score {', '.join(parts)}" + (f" ({lost} diverged)" if lost else "")
