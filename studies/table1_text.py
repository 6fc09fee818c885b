"""Table 1 as Markdown, CSV and LaTeX. Every number comes from `Results`; a cell without records is a dash."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence

from studies.paper import LABELS
from studies.table1 import Comparison, Entry, Results
from velap.evaluation.summary import Summary, markdown_rows

MISSING = "–"
"""A cell without records."""
CSV_COLUMNS = (
    "task", "method", "preset", "train_seed", "episodes", "successes", "success_percent", "wilson_low_percent",
    "wilson_high_percent", "seeds", "mean_percent", "spread_percent", "paper_percent", "paper_deviation_percent",
    "mean_steps", "plan_ms_p50", "plan_ms_p95", "training_seconds", "config_hash", "checkpoint", "code_versions", "records",
)


def label(method: str) -> str:
    """How tables name a method."""
    return LABELS.get(method, method)


def success(entry: Entry) -> str:
    """`97.0 (91.5 to 99.0)` of one training seed, `95.5 ± 2.1 (2 seeds)` of several [%]."""
    if not entry.runs:
        return MISSING
    mean, spread = entry.rate
    if len(entry.runs) > 1:
        return f"{mean:.1f} ± {spread:.1f} ({len(entry.runs)} seeds)"
    low, high = _interval(entry.runs[0].summary)
    return f"{mean:.1f} ({low:.1f} to {high:.1f})"


def published(entry: Entry) -> str:
    """`94 ± 3` [%]; a dash for methods that the paper does not have."""
    cell = entry.published
    return MISSING if cell is None else f"{cell.mean} ± {cell.deviation}"


def plan_time(entry: Entry) -> str:
    """Median and 95th percentile of the planning time, the mean of the training seeds' [ms]; a dash where nothing plans."""
    times = [(run.summary.plan_ms_p50, run.summary.plan_ms_p95) for run in entry.runs]
    known = [pair for pair in times if not math.isnan(pair[0])]
    if not known:
        return MISSING
    middle, high = (sum(values) / len(known) for values in zip(*known, strict=True))
    return f"{middle:.1f} / {high:.1f}"


def training_time(entry: Entry) -> str:
    """Mean training time of a run [min]."""
    return MISSING if entry.training_seconds is None else f"{entry.training_seconds / 60:.1f}"


def markdown_matrix(entries: Sequence[Entry]) -> str:
    """Methods × tasks of one preset, the paper's figure below each of ours [%]."""
    tasks = tuple(dict.fromkeys(entry.task for entry in entries))
    cells = {(entry.method, entry.task): f"{success(entry)}<br>paper {published(entry)}" for entry in entries}
    methods = dict.fromkeys(entry.method for entry in entries)
    rows = [(f"**{label(method)}**", *(cells[method, task] for task in tasks)) for method in methods]
    return markdown_rows(("method", *tasks), rows)


def markdown_cells(entries: Sequence[Entry]) -> str:
    """One row a cell of one preset, with plan and training times; tasks without any record are left to the matrix."""
    recorded = {entry.task for entry in entries if entry.runs}
    rows = [(entry.task, label(entry.method), ", ".join(str(run.cell.seed) for run in entry.runs) or MISSING,
             success(entry), published(entry), plan_time(entry), training_time(entry))
            for entry in entries if entry.task in recorded]
    return markdown_rows(("task", "method", "training seeds", "success [%]", "paper [%]", "plan p50 / p95 [ms]",
                          "training [min]"), rows)


def markdown_comparisons(comparisons: Sequence[Comparison]) -> str:
    """VELAP against the best baseline of each task."""
    rows = [(one.task, one.preset, label(one.baseline), f"{one.velap_rate:.1f}", f"{one.baseline_rate:.1f}",
             str(one.test.episodes), str(one.test.discordant), f"{one.test.only_first} / {one.test.only_second}",
             p_value(one.test.p_value)) for one in comparisons]
    return markdown_rows(("task", "preset", "best baseline", "VELAP [%]", "baseline [%]", "pairs", "discordant",
                          "only VELAP / only baseline", "p (McNemar, exact)"), rows)


def p_value(value: float) -> str:
    """`0.031`, or `< 0.001`."""
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def to_csv(results: Results) -> str:
    """One line a training seed of every cell; a missing cell has a line without numbers."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for entry in results.entries:
        writer.writerows(_csv_lines(entry))
    return text.getvalue()


def _csv_lines(entry: Entry) -> list[tuple[str, ...]]:
    paper = entry.published
    reported = ("", "") if paper is None else (str(paper.mean), str(paper.deviation))
    if not entry.runs:
        line = (entry.task, entry.method, entry.preset, *[""] * 6, "0", "", "", *reported)
        return [(*line, *[""] * (len(CSV_COLUMNS) - len(line)))]
    mean, spread = entry.rate
    lines = []
    for run in entry.runs:
        summary, (low, high) = run.summary, _interval(run.summary)
        numbers = [100 * summary.success_rate, low, high]
        after = [summary.mean_steps, summary.plan_ms_p50, summary.plan_ms_p95, run.training_seconds]
        lines.append((entry.task, entry.method, entry.preset, str(run.cell.seed), str(summary.episodes),
                      str(summary.successes), *map(_number, numbers), str(len(entry.runs)), _number(mean), _number(spread),
                      *reported, *map(_number, after), run.config_hash, run.checkpoint, " ".join(summary.code_versions),
                      str(run.path)))
    return lines


def _number(value: float | None) -> str:
    """Three decimals, nothing where there is no number."""
    return "" if value is None or math.isnan(value) else f"{value:.3f}"


def _interval(summary: Summary) -> tuple[float, float]:
    """95 % Wilson interval [%]."""
    return 100 * summary.wilson_low, 100 * summary.wilson_high


def to_latex(results: Results, preset: str) -> str:
    """The table in the paper's shape: a row a task with ours, the paper's below; needs the package booktabs."""
    entries = results.of(preset)
    methods = tuple(dict.fromkeys(entry.method for entry in entries))
    lines = [
        f"% Generated by `velap table 1` from the episode records, preset {preset}. Needs \\usepackage{{booktabs}}.",
        f"\\begin{{tabular}}{{l{'c' * len(methods)}}}",
        "\\toprule",
        " & ".join(["", *(_latex(label(method)) for method in methods)]) + r" \\",
        "\\midrule",
    ]
    for task in dict.fromkeys(entry.task for entry in entries):
        row = {entry.method: entry for entry in entries if entry.task == task}
        best = max((entry.rate[0] for entry in row.values() if entry.runs), default=math.inf)
        lines.append(" & ".join([_latex(task), *(_latex_cell(row[method], best) for method in methods)]) + r" \\")
        lines.append(" & ".join(["\\quad paper", *(_latex(published(row[method])) for method in methods)]) + r" \\")
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}"]) + "\n"


def _latex_cell(entry: Entry, best: float) -> str:
    """A cell, bold where no method of the task is better and any episode was solved."""
    text = _latex(success(entry))
    return f"\\textbf{{{text}}}" if entry.runs and entry.rate[0] == best > 0 else text


def _latex(text: str) -> str:
    """Plain text with what LaTeX takes for commands spelled out."""
    for plain, escaped in (("%", r"\%"), ("_", r"\_"), ("±", r"$\pm$"), ("*", r"$^*$"), ("–", "--")):
        text = text.replace(plain, escaped)
    return text
