"""The paper's tables 1 to 4 of pooled runs, as values; `experiments.evidence.formats` writes them.

An incomplete cell has footnotes that say why, and an empty cell stays empty: its numbers come from its own runs only.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

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
from experiments.evidence.comparisons import against_baseline, variants_compared
from experiments.evidence.groups import PROTOCOL, Group, setting_text
from experiments.evidence.pooling import AlgorithmRow, Collected, row_differences
from experiments.evidence.published import Published
from experiments.evidence.task_sizes import table_1
from experiments.evidence.variants import BATCH_STD, TRANSITION_STD, baseline_of

NAMES = ("table1", "table2", "table2_improvement", "table3", "table3_change", "table4", "seeds")


def spread(values: np.ndarray) -> dict[str, float | None]:
    """Mean, std (ddof 0) and IQM of `values` [seeds], with 95 % bootstrap intervals; one seed has no interval."""
    found: dict[str, float | None] = {"mean": float(values.mean()), "std": float(values.std())}
    found["iqm"] = float(statistics.iqm(values))
    for name, statistic in (("mean", statistics.mean), ("iqm", statistics.iqm)):
        low, high = statistics.bootstrap(statistic, values) if len(values) > 1 else (None, None)
        found |= {f"{name}_low": finite(low), f"{name}_high": finite(high)}
    return found


def make_tables(
    collected: Collected, reference: bool = False, sizes: Sequence[dict[str, Any]] = ()
) -> list[ResultTable]:
    """All tables that are not empty.

    Args:
      reference: also show published numbers.
      sizes: of the tasks, for table 1 (`task_sizes.read_sizes`).
    """
    tables = [table_1(sizes, reference), table_2(collected, reference)]
    tables += [against_baseline(collected, reference, "table2_improvement"), table_3(collected, reference)]
    tables += [against_baseline(collected, reference, "table3_change"), table_4(collected, reference)]
    tables += [seeds_table(collected)]
    return [table for table in tables if any(table.sections)]


def table_2(collected: Collected, reference: bool) -> ResultTable:
    """Scores; `reference`: with published ones."""
    caption = (
        "Score: the best evaluation of the mean over seeds, ± the std over seeds at that evaluation (ddof 0, "
        "population), and the number of seeds. Below: the IQM of the seeds at that evaluation and its 95 % bootstrap "
        f"interval; {NOT_RESAMPLED}."
    )
    figures = published.scores() if reference else []
    table = ("table2", "Table 2: maximum average return", caption)
    return _algorithms(table, collected, collected.rows, _score_cell, "score", figures)


def table_3(collected: Collected, reference: bool) -> ResultTable:
    """The critics' disagreement; `reference`: with the paper's."""
    caption = (
        "std_T: q_std, the std over critics with the penalty's ddof (setting ddof, 1 by default), averaged with equal "
        "weights over the intervals between evaluations in which all seeds had updates; ± the std over seeds (ddof 0, "
        "population), and the number of seeds. Below: its IQM and 95 % bootstrap interval. Bias: value_bias over the "
        "same evaluations, where it was measured."
    )
    figures = published.q_stds() if reference else []
    table = ("table3", "Table 3: disagreement of the critics (std_T)", caption)
    return _algorithms(table, collected, collected.rows, _q_std_cell, "q_std", figures)


def table_4(collected: Collected, reference: bool) -> ResultTable:
    """Scores of SQT and SQT-tuple, and their comparisons; only for baselines with which SQT-tuple was run."""
    both = [row for row in collected.rows if row.penalty in (BATCH_STD, TRANSITION_STD)]
    baselines = {baseline_of(row.algo) for row in both if row.penalty == TRANSITION_STD}
    rows = [row for row in both if baseline_of(row.algo) in baselines]
    caption = (
        "Scores as in table 2. Comparisons: by how many per cent the first score exceeds the second, and P, the "
        "probability that a seed of the first exceeds a seed of the second, with 95 % bootstrap intervals; "
        f"{NOT_RESAMPLED}."
    )
    figures = published.scores() if reference else []
    keep = {row.algo for row in rows}
    figures = [figure for figure in figures if figure.algo in keep]  # not of their baselines
    title = "Table 4: SQT (std averaged over the batch) against SQT-tuple (std of each transition)"
    table = _algorithms(("table4", title, caption), collected, rows, _score_cell, "score", figures)
    notes = Notes(table.notes)
    lines, records = variants_compared(rows, collected, notes)
    table.records.extend(records)
    return table._replace(sections=[*table.sections, lines] if lines else table.sections, notes=notes.texts)


def seeds_table(collected: Collected) -> ResultTable:
    """The values of each seed."""
    notes = Notes()
    lines, records = [], []
    for row in collected.rows:
        for task, group in row.groups.items():
            returns = group.values("return_mean")
            values = {"at the score": group.scores, "at the end": group.finals, "q_std": group.mean_of("q_std")}
            bias = group.mean_of("value_bias")
            cells = [
                "  ".join(f"{seed}: {number(v)}" for seed, v in zip(group.seeds, own, strict=True))
                if own is not None
                else NOTHING
                for own in values.values()
            ]
            marks = notes(*group.notes)
            lines.append(Line([Cell((row.label,), marks), Cell((task,)), *(Cell((cell,)) for cell in cells)]))
            for index, member in enumerate(group.members):
                own = returns[index]
                best = int(np.nanargmax(own)) if np.isfinite(own).any() else None
                at_score, q_std = values["at the score"], values["q_std"]
                records.append(
                    {"algo": row.algo, "row": row.label, "env": task, "seed": member.seed}
                    | {"return_at_score": at_score[index] if at_score is not None else None}
                    | {"score_env_steps": group.scored_at, "final_return": own[-1]}
                    | {"best_return": own[best] if best is not None else None}
                    | {"best_env_steps": int(group.env_steps[best]) if best is not None else None}
                    | {"q_std": q_std[index] if q_std is not None else None}
                    | {"value_bias": bias[index] if bias is not None else None, "run": str(member.run)}
                )
    header = ["algorithm", "task", "return at the score's evaluation, by seed", "at the last one", "std_T"]
    caption = "The seeds' values from which the tables above are computed."
    return ResultTable(
        name="seeds",
        title="Seeds",
        header=header,
        sections=[lines],
        caption=caption,
        notes=notes.texts,
        records=records,
    )


def _algorithms(
    table: tuple[str, str, str],
    collected: Collected,
    rows: Sequence[AlgorithmRow],
    cell_of: Callable[[Group], tuple[tuple[str, ...], dict[str, Any], list[str]]],
    quantity: str,
    figures: Sequence[Published],
) -> ResultTable:
    """Algorithms × tasks, with published numbers below each algorithm.

    Args:
      table: name, title and caption.
      cell_of: a group's lines of text, its numbers, and its footnotes in addition to the group's notes.
      quantity: of the records.
      figures: published numbers, of the baselines too.
    """
    notes = Notes()
    most = max((len(group.seeds) for group in collected.groups), default=0)
    sections, records = [], []
    shown = dict.fromkeys(row.algo for row in rows)
    if figures:
        shown = dict.fromkeys(name for algo in shown for name in (baseline_of(algo), algo))
    for algo in shown:
        lines = []
        for row in (row for row in rows if row.algo == algo):
            cells = [Cell((row.label,), notes(*_row_notes(row)))]
            for task in collected.tasks:
                group = row.groups.get(task)
                if group is None:
                    cells.append(Cell((NOTHING,), notes("not run")))
                    continue
                text, numbers, why = cell_of(group)
                why = [*group.notes, *why]
                if len(group.seeds) < most:
                    why.append(f"fewer seeds than other cells, which have {most}")
                cells.append(Cell(text, notes(*why, *group.tuned)))
                records.append(_record(row, group, quantity, numbers, why))
            penalised = [g for g in row.groups.values() if g.settings["penalty"] != "none"]
            coefs = dict.fromkeys(group.settings["penalty_coef"] for group in penalised)
            cells.append(Cell((" / ".join(map(setting_text, coefs)) or NOTHING,)))
            for name in ("steps", "updates_per_step"):
                values = dict.fromkeys(group.settings[name] for group in row.groups.values())
                cells.append(Cell((" / ".join(map(setting_text, values)),)))
            lines.append(Line(cells))
        known = [figure for figure in figures if figure.algo == algo and figure.env in collected.tasks]
        lines += _published_lines(known, collected.tasks, notes)
        records += [_published_record(figure, quantity) for figure in known]
        if lines:
            sections.append(lines)
    name, title, caption = table
    header = ["algorithm", *collected.tasks, "penalty_coef", "steps", "UTD"]
    texts = [caption, *_protocol_notes(rows), *map(_sentence, collected.notes)]
    if figures and not any(line.published for lines in sections for line in lines):
        texts.append("No published numbers for these algorithms and tasks.")
    return ResultTable(
        name=name,
        title=title,
        header=header,
        sections=sections,
        caption=" ".join(texts),
        notes=notes.texts,
        records=records,
    )


def _score_cell(group: Group) -> tuple[tuple[str, ...], dict[str, Any], list[str]]:
    if group.score is None or group.scores is None:
        return (NOTHING,), {}, ["its seeds have no evaluation in common"]
    found = spread(group.scores)
    final = {f"final_{name}": value for name, value in spread(group.finals).items()}
    numbers = found | {"score_env_steps": group.scored_at, "per_seed": joined(group.scores)} | final
    return _spread_lines(found, len(group.seeds)), numbers, []


def _q_std_cell(group: Group) -> tuple[tuple[str, ...], dict[str, Any], list[str]]:
    values, bias = group.mean_of("q_std"), group.mean_of("value_bias")
    if values is None:
        return (NOTHING,), {}, ["no interval in which all its seeds measured q_std"]
    found = spread(values)
    lines, numbers = _spread_lines(found, len(group.seeds)), found | {"per_seed": joined(values)}
    if bias is not None:
        lines = (*lines, f"bias {number(bias.mean(), sign=True)} ± {number(bias.std())}")
    for column in group.columns("value_bias"):
        measured = group.mean_of(column)
        if measured is not None:
            numbers |= {f"{column}_{name}": value for name, value in spread(measured).items()}
            numbers |= {f"{column}_per_seed": joined(measured)}
    return lines, numbers, []


def _spread_lines(found: Mapping[str, float | None], seeds: int) -> tuple[str, ...]:
    first = f"{number(found['mean'])} ± {number(found['std'])} ({seeds})"
    if found["iqm_low"] is None:
        return (first,)
    return first, f"{number(found['iqm'])} {interval(found['iqm_low'], found['iqm_high'])}"


def _published_lines(figures: Sequence[Published], tasks: Sequence[str], notes: Notes) -> list[Line]:
    """A line per source, with its numbers in the columns of their tasks."""
    sources: dict[tuple[str, ...], dict[str, Published]] = {}
    for figure in figures:
        key = (figure.algo, figure.source, figure.env_version, figure.seeds, figure.updates_per_step)
        sources.setdefault(key, {})[figure.env] = figure
    lines = []
    for (algo, source, version, seeds, utd), by_task in sources.items():
        cells = [Cell((f"published: {algo}, environment {version}, {seeds} seeds", source))]
        for task in tasks:
            if task not in by_task:
                cells.append(Cell((NOTHING,)))
                continue
            figure = by_task[task]
            text = number(figure.value) + (f" ± {number(figure.std)}" if figure.std is not None else "")
            cells.append(Cell((text,), notes(*figure.notes)))
        lines.append(
            Line([*cells, *(Cell((text,)) for text in (NOTHING, "1,000,000", utd or NOTHING))], published=True)
        )
    return lines


def _published_record(figure: Published, quantity: str) -> dict[str, Any]:
    where = {"algo": figure.algo, "row": f"published: {figure.algo}", "env": figure.env, "quantity": quantity}
    numbers = {"mean": figure.value, "std": figure.std, "seeds": figure.seeds, "steps": 1_000_000}
    source = {"updates_per_step": figure.updates_per_step, "env_version": figure.env_version, "source": figure.source}
    return where | numbers | source | {"notes": "; ".join(figure.notes)}


def _record(
    row: AlgorithmRow, group: Group, quantity: str, numbers: Mapping[str, Any], why: Sequence[str]
) -> dict[str, Any]:
    settings = {name: group.settings[name] for name in ("penalty_coef", *PROTOCOL)}
    where = {"algo": row.algo, "row": row.label, "env": group.env, "quantity": quantity}
    return (
        where
        | dict(numbers)
        | {"seeds": joined(group.seeds)}
        | settings
        | {"source": "", "notes": "; ".join(why)}
        | ({"tuned": "; ".join(group.tuned)} if group.tuned else {})
    )


def _row_notes(row: AlgorithmRow) -> list[str]:
    """The settings in which a row's tasks differ, except those with a column or in the caption."""
    found = []
    for name, values in row_differences(row).items():
        if name not in ("steps", "updates_per_step", *PROTOCOL):
            pairs = ", ".join(f"{setting_text(value)} ({task})" for task, value in values.items())
            found.append(f"{name}: {pairs}")
    return found


def _protocol_notes(rows: Sequence[AlgorithmRow]) -> list[str]:
    """The protocol that all cells have in common, and the cells that differ from it."""
    groups = [(row, group) for row in rows for group in row.groups.values()]
    common, differing = [], []
    for name in PROTOCOL[2:]:
        values: dict[Any, list[str]] = {}
        for row, group in groups:
            values.setdefault(group.settings[name], []).append(f"{row.label} on {group.env}")
        if len(values) == 1:
            common.append(f"{name} {setting_text(next(iter(values)))}")
        elif values:
            ranked = sorted(values.items(), key=lambda item: -len(item[1]))
            rest = "; ".join(f"{setting_text(value)} for {', '.join(where)}" for value, where in ranked[1:])
            differing.append(f"Cells differ in {name}: it is {setting_text(ranked[0][0])}, but {rest}.")
    return ([f"Common to all: {', '.join(common)}."] if common else []) + differing


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}".rstrip(".") + "."
