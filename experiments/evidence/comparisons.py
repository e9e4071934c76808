"""Comparisons of scores and std_T, in per cent and as a probability.

Either an SQT variant against its baseline, or two SQT variants of one baseline against each other.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.evidence import published, statistics
from experiments.evidence.cells import (
    NOT_RESAMPLED,
    NOTHING,
    Cell,
    Line,
    Notes,
    ResultTable,
    finite,
    interval,
    joined,
    number,
)
from experiments.evidence.groups import PENALTY, Group, differences_text
from experiments.evidence.pooling import AlgorithmRow, Collected
from experiments.evidence.variants import BATCH_STD, TRANSITION_STD, baseline_of, variant_with


class Comparison(NamedTuple):
    """A group and the group of the same task that it is compared with."""

    group: Group
    other: Group | None  # None: nothing to compare with
    note: str = ""  # the reason if `other` is None


def against_baseline(collected: Collected, reference: bool, name: str) -> ResultTable:
    """Each SQT variant against its baseline.

    Args:
      reference: also show the paper's mean improvements.
      name: of the table: `table2_improvement` compares the score, `table3_change` std_T.
    """
    score = name == "table2_improvement"
    what = "score" if score else "std_T"
    values_of: Callable[[Group], np.ndarray | None] = (
        (lambda group: group.scores) if score else lambda group: group.mean_of("q_std")
    )
    notes = Notes()
    lines, records = [], []
    for row in collected.rows:
        if row.penalty is None or baseline_of(row.algo) == row.algo:  # an unknown algorithm has no baseline
            continue
        pairs = {}
        for task, group in row.groups.items():
            baseline = collected.baseline(group)
            pairs[task] = Comparison(group, baseline.group, baseline.note)
        line, found = _compared(
            f"{row.label} against {baseline_of(row.algo)}", pairs, collected.tasks, values_of, notes
        )
        lines.append(line)
        records += found
    if reference and lines:
        numbers = published.paper()
        if score:
            shown = {row.algo for row in collected.rows}
            quoted = {
                f"{variant} against {baseline}": value
                for baseline, value in numbers["table2_improvement_percent_mean_over_tasks"].items()
                if (variant := variant_with(baseline, BATCH_STD)) in shown
            }
        else:
            quoted = {"with SQT against without": numbers["table3_q_std"]["mean_improvement_percent"]}
        for label, value in quoted.items():
            cells = [Cell((f"published: {label}", f"{published.PAPER}; 1,000,000 steps, its four tasks"))]
            cells += [Cell(("",)) for _ in collected.tasks]
            lines.append(Line([*cells, Cell((f"{number(value, sign=True)} %",)), Cell((NOTHING,))], published=True))
            over_tasks = {"env": "mean over tasks", "improvement_percent": value, "source": published.PAPER}
            records.append({"comparison": label} | over_tasks)
    caption = (
        f"Per task: by how many per cent the mean {what} over seeds exceeds the baseline's, and P, the probability "
        "that a seed exceeds a seed of the baseline (a tie counts one half)."
    )
    title = f"{'Table 2' if score else 'Table 3'}, SQT variants against their baselines: {what}"
    header = ["comparison", *collected.tasks, "mean over tasks", "P over tasks"]
    if len(collected.tasks) == 1 and not any(line.published for line in lines):
        header, lines = header[:-2], [Line(line.cells[:-2]) for line in lines]
    else:
        caption += " Last columns: the means over the tasks that can be compared."
    caption += " In brackets: 95 % intervals by bootstrap over seeds, stratified by algorithm and task"
    caption += f"; {NOT_RESAMPLED}." if score else "."
    return ResultTable(
        name=name,
        title=title,
        header=header,
        sections=[lines] if lines else [],
        caption=caption,
        notes=notes.texts,
        records=records,
    )


def variants_compared(
    rows: Sequence[AlgorithmRow], collected: Collected, notes: Notes
) -> tuple[list[Line], list[dict[str, Any]]]:
    """The scores of SQT against those of SQT-tuple with the same baseline: lines of table 4, and the full numbers."""
    lines, records = [], []
    for row in rows:
        for other in rows:
            same = baseline_of(row.algo) == baseline_of(other.algo)
            if not same or (row.penalty, other.penalty) != (BATCH_STD, TRANSITION_STD):
                continue
            pairs = {}
            for task, group in row.groups.items():
                alike = [g for g in collected.counterparts(group, other.algo) if g is other.groups.get(task)]
                if alike:
                    pairs[task] = Comparison(group, alike[0])
                elif task in other.groups:
                    why = differences_text(group, other.groups[task], PENALTY)
                    pairs[task] = Comparison(group, None, f"not compared: {why}")
            label = f"{row.label} against {other.label}"
            line, found = _compared(label, pairs, collected.tasks, lambda group: group.scores, notes)
            # This table has no columns for the last two cells, which are over tasks: they stand under the label.
            over_tasks = [cell for cell in line.cells[-2:] if cell.lines != (NOTHING,)]
            words = [f"over tasks: {' '.join(cell.lines)}" for cell in over_tasks] if len(collected.tasks) > 1 else []
            line.cells[0] = Cell((label, *words))
            lines.append(Line([*line.cells[:-2], *(Cell(("",)) for _ in range(3))]))
            records += found
    return lines, records


def _compared(
    label: str,
    pairs: Mapping[str, Comparison],
    tasks: Sequence[str],
    values_of: Callable[[Group], np.ndarray | None],
    notes: Notes,
) -> tuple[Line, list[dict[str, Any]]]:
    """A line of comparisons and the full numbers. The last two cells are over all tasks that can be compared.

    Args:
      values_of: the values of a group that are compared, [seeds], or None.
    """
    cells, records, strata, all_marks = [Cell((label,))], [], [], set()
    for task in tasks:
        if task not in pairs:
            cells.append(Cell((NOTHING,), notes("not run")))
            continue
        group, other, note = pairs[task]
        why = [note] if note else []
        x, y = values_of(group), values_of(other) if other else None
        if other is not None:
            why += [f"{one.algo} on {task}: {note}" for one in (group, other) for note in one.notes]
        if x is None or y is None or other is None:
            cells.append(Cell((NOTHING,), notes(*(why or ["not measured"]))))
            continue
        found = _against(x, y)
        why += _percentage_notes(found)
        marks = notes(*why, *(f"{one.algo} on {task}: {text}" for one in (group, other) for text in one.tuned))
        all_marks |= set(marks)
        strata += [x, y]
        cells.append(Cell(_against_lines(found), marks))
        records.append(
            {"comparison": label, "env": task}
            | found
            | {"seeds": joined(group.seeds), "other_seeds": joined(other.seeds), "notes": "; ".join(why)}
        )
    if not strata:
        return Line([*cells, Cell((NOTHING,)), Cell((NOTHING,))]), records
    found = _against(*strata)
    lines = _against_lines(found)
    missing = len(strata) // 2 < len(tasks)
    why = _percentage_notes(found) + (["not over all tasks"] if missing else [])
    marks = tuple(sorted(all_marks | set(notes(*why))))
    cells += [Cell((lines[0],), marks), Cell((lines[1],), marks)]
    over = {"comparison": label, "env": "mean over tasks"} | found
    return Line(cells), [*records, over | {"notes": "; ".join(notes.texts[mark - 1] for mark in marks)}]


def _against(*strata: np.ndarray) -> dict[str, float | None]:
    """Improvement and probability, each with its interval, of `x, y` of a task, then of the next; [seeds] each."""
    statistic = {"improvement": statistics.improvement, "probability": statistics.probability_of_improvement}
    found: dict[str, float | None] = {}
    for name, function in statistic.items():
        key = "improvement_percent" if name == "improvement" else "probability_of_improvement"
        # With a single seed every resample is the same: the interval would show no spread on that side.
        single = any(len(stratum) == 1 for stratum in strata)
        low, high = (None, None) if single else statistics.bootstrap(function, *strata)
        found |= {key: finite(function(*strata)), f"{name}_low": finite(low), f"{name}_high": finite(high)}
    return found


def _percentage_notes(found: Mapping[str, float | None]) -> list[str]:
    """The reasons for a missing percentage or a missing interval."""
    if found["improvement_percent"] is None:
        return ["no percentage: the other mean is not positive"]
    if found["improvement_low"] is None and found["probability_low"] is not None:
        return ["no interval of the percentage: the other mean is not positive in some resamples"]
    return []


def _against_lines(found: Mapping[str, float | None]) -> tuple[str, str]:
    value = found["improvement_percent"]
    percent = NOTHING
    if value is not None:
        percent = f"{number(value, sign=True)} % {interval(found['improvement_low'], found['improvement_high'])}"
    chance = f"P {number(found['probability_of_improvement'])} "
    return percent.strip(), (chance + interval(found["probability_low"], found["probability_high"])).strip()
