"""Statistics and tables, computed from episode records alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from velap.errors import RecordError
from velap.evaluation.records import Record, read_all
from velap.runs import write_atomic

TABLE_START = "<!-- velap table: start -->"
TABLE_END = "<!-- velap table: end -->"
Episodes = Mapping[tuple[int, int], bool]
"""(training seed, episode seed) -> success."""


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Statistics of one run's records."""

    task: str
    method: str
    preset: str
    train_seed: int
    episodes: int
    successes: int
    wilson_low: float
    """Lower end of the 95 % Wilson interval of the success rate [fraction]."""
    wilson_high: float
    mean_steps: float
    """Mean length of all episodes, failed ones included [steps]."""
    mean_success_steps: float
    """Mean length of the successful episodes, NaN without any [steps]."""
    mean_plans: float
    """Mean number of plans an episode."""
    plan_share: float
    """Share of all steps whose action followed an edge of the current tree, NaN if not recorded [fraction]."""
    plan_ms_p50: float
    """Median planning time, NaN without plans [ms]."""
    plan_ms_p95: float
    code_versions: tuple[str, ...]

    @property
    def success_rate(self) -> float:
        """Share of successful episodes."""
        return self.successes / self.episodes


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """95 % Wilson score interval of a success rate [fraction]."""
    interval = binomtest(successes, episodes).proportion_ci(confidence_level=0.95, method="wilson")
    return float(interval.low), float(interval.high)


def summarise(records: Sequence[Record]) -> Summary:
    """Statistics of one run's records; every record counts."""
    if not records:
        raise RecordError("there are no records to summarise; run `velap evaluate` first.")
    first = records[0]
    successes = sum(record.success for record in records)
    low, high = wilson(successes, len(records))
    plans = np.array([value for record in records for value in record.plan_ms])
    succeeded = [record.steps for record in records if record.success]
    return Summary(
        task=first.task, method=first.method, preset=first.preset, train_seed=first.train_seed,
        episodes=len(records), successes=successes, wilson_low=low, wilson_high=high,
        mean_steps=float(np.mean([record.steps for record in records])),
        mean_success_steps=float(np.mean(succeeded)) if succeeded else math.nan,
        mean_plans=len(plans) / len(records), plan_share=_plan_share(records),
        plan_ms_p50=float(np.percentile(plans, 50)) if len(plans) else math.nan,
        plan_ms_p95=float(np.percentile(plans, 95)) if len(plans) else math.nan,
        code_versions=tuple(sorted({record.code_version for record in records})),
    )


def _plan_share(records: Sequence[Record]) -> float:
    """Share of the steps led by a plan; NaN unless every record has it."""
    led = [record.plan_steps for record in records if record.plan_steps is not None]
    return sum(led) / sum(record.steps for record in records) if len(led) == len(records) else math.nan


def mean_and_spread(rates: Sequence[float]) -> tuple[float, float]:
    """Mean and sample standard deviation (n - 1) over training seeds, in the unit of `rates`; the spread of one is NaN."""
    if not rates:
        raise RecordError("there are no runs to average; run `velap table 1` first.")
    return float(np.mean(rates)), float(np.std(rates, ddof=1)) if len(rates) > 1 else math.nan


@dataclass(frozen=True, kw_only=True)
class Paired:
    """McNemar's exact test of two methods on the same episodes."""

    episodes: int
    """Pairs."""
    only_first: int
    """Solved by the first method and not by the second."""
    only_second: int
    p_value: float
    """Two-sided; 1 without discordant pairs."""

    @property
    def discordant(self) -> int:
        """Pairs in which exactly one method succeeds: only these count."""
        return self.only_first + self.only_second


def mcnemar(first: Episodes, second: Episodes) -> Paired:
    """Compare two methods on their common episodes; raises RecordError without any.

    Exact form: under equal success rates each discordant pair falls to either side with probability 1/2.
    """
    shared = first.keys() & second.keys()
    if not shared:
        raise RecordError("the two methods have no episode of the same training and episode seed; evaluate both on the same "
                          "seeds.")
    only_first = sum(first[key] and not second[key] for key in shared)
    only_second = sum(second[key] and not first[key] for key in shared)
    discordant = only_first + only_second
    p_value = float(binomtest(only_first, discordant, 0.5).pvalue) if discordant else 1.0
    return Paired(episodes=len(shared), only_first=only_first, only_second=only_second, p_value=p_value)


COLUMNS = ("task", "method", "preset", "train seed", "episodes", "success [%] (95 % interval)", "steps: solved / all",
           "plan p50 / p95 [ms]")


def cells(summary: Summary) -> tuple[str, ...]:
    """One row of a table, in the order of `COLUMNS`."""
    def number(value: float) -> str:
        return "-" if math.isnan(value) else f"{value:.1f}"

    interval = f"{100 * summary.wilson_low:.1f} to {100 * summary.wilson_high:.1f}"
    return (summary.task, summary.method, summary.preset, str(summary.train_seed), str(summary.episodes),
            f"{100 * summary.success_rate:.1f} ({interval})",
            f"{number(summary.mean_success_steps)} / {number(summary.mean_steps)}",
            f"{number(summary.plan_ms_p50)} / {number(summary.plan_ms_p95)}")


def summary_text(summary: Summary) -> str:
    """One run, one line a number."""
    width = max(map(len, COLUMNS))
    return "\n".join(f"{name:{width}}  {cell}" for name, cell in zip(COLUMNS, cells(summary), strict=True))


def markdown_table(summaries: Iterable[Summary]) -> str:
    """One line a run, in Markdown."""
    return markdown_rows(COLUMNS, [cells(summary) for summary in summaries])


def markdown_rows(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with aligned columns."""
    widths = [max(3, *(len(line[index]) for line in (columns, *rows))) for index in range(len(columns))]
    lines = [columns, ["-" * width for width in widths], *rows]
    return "\n".join("| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |"
                     for line in lines)


def summarise_all(root: Path) -> list[Summary]:
    """A summary of every record file below `root`, sorted by task, method, preset and training seed."""
    files = {path: records for path, records in read_all(root).items() if records}
    if not files:
        raise RecordError(f"there are no records below {root}; run `velap evaluate TASK --checkpoint F` first, or name "
                          "another folder with --records.")
    summaries = [summarise(records) for records in files.values()]
    return sorted(summaries, key=lambda summary: (summary.task, summary.method, summary.preset, summary.train_seed))


def write_into(document: Path, table: str) -> None:
    """Replace the text between the two table marks of `document`."""
    text = document.read_text(encoding="utf-8") if document.is_file() else ""
    if text.count(TABLE_START) != 1 or text.count(TABLE_END) != 1:
        raise RecordError(f"{document} has no place for the table; put the lines {TABLE_START!r} and {TABLE_END!r} where it "
                          "belongs.")
    before, rest = text.split(TABLE_START)
    after = rest.split(TABLE_END)[1]
    write_atomic(document, f"{before}{TABLE_START}\n{table}\n{TABLE_END}{after}".encode())
