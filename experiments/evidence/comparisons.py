"""How scores and std_T compare, in per cent and as a probability: with the base's, and of one form with another's."""

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
    Table,
    finite,
    interval,
    joined,
    number,
)
from experiments.evidence.pooling import PENALTY, Collected, Group, Row, base_algorithm, differing


class Comparison(NamedTuple):
    """One group against another of the same task; `other` is None where there is none, and `note` says why."""

    group: Group
    other: Group | None
    note: str = ""


def versus_base(collected: Collected, reference: bool, name: str) -> Table:
    """Each algorithm with a penalty against its base: the score (table 2), or the disagreement (table 3)."""
    score = name == "table2_improvement"
    what = "score" if score else "std_T"
    values_of: Callable[[Group], np.ndarray | None] = (
        (lambda group: group.scores) if score else lambda group: group.mean_of("q_std")
    )
    notes = Notes()
    lines, records = [], []
    for row in collected.rows:
        if not has_penalty(row):
            continue
        pairs = {}
        for task, group in row.groups.items():
            base = collected.base(group)
            pairs[task] = Comparison(group, base.group, base.note)
        line, found = _compared(
            f"{row.label} against {base_algorithm(row.algo)}", pairs, collected.tasks, values_of, notes
        )
        lines.append(line)
        records += found
    if reference and lines:
        numbers = published.paper()
        if score:
            quoted = {f"{algo}_sqt": v for algo, v in numbers["table2_improvement_percent_mean_over_tasks"].items()}
            shown = {row.algo for row in collected.rows}
            quoted = {f"{algo} against {base_algorithm(algo)}": v for algo, v in quoted.items() if algo in shown}
        else:
            quoted = {"with SQT against without": numbers["table3_q_std"]["mean_improvement_percent"]}
        for label, value in quoted.items():
            cells = [Cell((f"published: {label}", f"{published.PAPER}; 1,000,000 steps, its four tasks"))]
            cells += [Cell(("",)) for _ in collected.tasks]
            lines.append(Line([*cells, Cell((f"{number(value, sign=True)} %",)), Cell((NOTHING,))], published=True))
            over_tasks = {"env": "mean over tasks", "improvement_percent": value, "source": published.PAPER}
            records.append({"comparison": label} | over_tasks)
    many = f"by how many per cent the mean {what} of the seeds exceeds the base's"
    caption = f"Per task: {many}, and P, the probability that a seed exceeds a seed of the base (a tie counts a half)."
    title = "Table 2, SQT against its base: score" if score else "Table 3, SQT against its base: std_T"
    header = ["comparison", *collected.tasks, "mean over tasks", "P over tasks"]
    if len(collected.tasks) == 1 and not any(line.published for line in lines):
        header, lines = header[:-2], [Line(line.cells[:-2]) for line in lines]
    else:
        caption += " The last columns: the means of these over the tasks compared."
    caption += " In brackets: 95 % intervals by stratified bootstrap, tasks and algorithms being the strata"
    caption += f"; {NOT_RESAMPLED}." if score else "."
    return Table(name, title, header, [lines] if lines else [], caption, notes.texts, records)


def forms_compared(rows: Sequence[Row], collected: Collected, notes: Notes) -> tuple[list[Line], list[dict[str, Any]]]:
    """The scores of the rows against those of their tuple forms: lines of table 4, and the full numbers."""
    lines, records = [], []
    for row in rows:
        for other in rows:
            if other.algo != f"{row.algo}_tuple":
                continue
            pairs = {}
            for task, group in row.groups.items():
                alike = [g for g in collected.counterparts(group, other.algo) if g is other.groups.get(task)]
                if alike:
                    pairs[task] = Comparison(group, alike[0])
                elif task in other.groups:
                    why = differing(group, other.groups[task], PENALTY)
                    pairs[task] = Comparison(group, None, f"not compared: {why}")
            label = f"{row.label} against {other.label}"
            line, found = _compared(label, pairs, collected.tasks, lambda group: group.scores, notes)
            # The last two cells are over tasks, for which there are no columns here: beneath the label instead.
            over_tasks = [cell for cell in line.cells[-2:] if cell.lines != (NOTHING,)]
            words = [f"over tasks: {' '.join(cell.lines)}" for cell in over_tasks] if len(collected.tasks) > 1 else []
            line.cells[0] = Cell((label, *words))
            lines.append(Line([*line.cells[:-2], *(Cell(("",)) for _ in range(3))]))
            records += found
    return lines, records


def has_penalty(row: Row) -> bool:
    found = [group.settings for group in row.groups.values()]
    return any(settings["penalty"] != "none" and settings["penalty_coef"] > 0 for settings in found)


def _compared(
    label: str,
    pairs: Mapping[str, Comparison],
    tasks: Sequence[str],
    values_of: Callable[[Group], np.ndarray | None],
    notes: Notes,
) -> tuple[Line, list[dict[str, Any]]]:
    """A line of comparisons, its last two cells over all tasks that can be compared, and the full numbers."""
    cells, records, strata, all_marks = [Cell((label,))], [], [], set()
    for task in tasks:
        if task not in pairs:
            cells.append(Cell((NOTHING,), notes("no such run")))
            continue
        group, other, note = pairs[task]
        why = [note] if note else []
        x, y = values_of(group), values_of(other) if other else None
        if other is not None:
            why += [f"{one.algo} on {task}: {note}" for one in (group, other) for note in one.notes]
        if x is None or y is None or other is None:
            cells.append(Cell((NOTHING,), notes(*(why or ["nothing measured that could be compared"]))))
            continue
        found = _against(x, y)
        why += _percentage_notes(found)
        marks = notes(*why)
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
    statistic = {"improvement": statistics.improvement, "probability": statistics.probability_of_improvement}
    found: dict[str, float | None] = {}
    for name, function in statistic.items():
        key = "improvement_percent" if name == "improvement" else "probability_of_improvement"
        # A seed that is alone is drawn again and again: the interval would leave that side's spread out.
        single = any(len(stratum) == 1 for stratum in strata)
        low, high = (None, None) if single else statistics.bootstrap(function, *strata)
        found |= {key: finite(function(*strata)), f"{name}_low": finite(low), f"{name}_high": finite(high)}
    return found


def _percentage_notes(found: Mapping[str, float | None]) -> list[str]:
    """Why there is no percentage, or no interval of it."""
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
