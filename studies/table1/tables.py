"""Tables 1 and 11 from records: a data frame with a row a training seed, and the CSV, LaTeX and Markdown made of it.

Statistics are `velap.evaluation.summary`'s. Records of another config are left out and named.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from studies.table1.cells import METHOD_ORDER, TABLES, Cell, look, training_seconds
from studies.table1.paper import TABLE_1, TABLE_11, TRIALS_11
from velap.evaluation.records import select
from velap.evaluation.summary import Episodes, mcnemar, mean_and_spread, summarise
from velap.methods.base import get_method
from velap.models.checkpoint import WEIGHTS_SHA256, shared_weights
from velap.tasks import PRESETS

MISSING = "–"
"""What was not measured."""
NO_BASELINES = ("velap", "random")
"""Methods that are not among those that VELAP is compared with."""
KEY = ["task", "method", "preset"]
NUMBERS = ["episodes", "successes", "success_percent", "wilson_low_percent", "wilson_high_percent"]
SPREAD = ["seeds", "mean_percent", "spread_percent", "paper_percent", "paper_deviation_percent"]
COST = ["mean_steps", "plan_ms_p50", "plan_ms_p95", "training_seconds"]
ORIGIN = ["config_hash", "checkpoint", "code_versions", "records"]
CSV_COLUMNS = [*KEY, "train_seed", *NUMBERS, *SPREAD, *COST, *ORIGIN]


@dataclass(frozen=True)
class Results:
    """The data of the table."""

    runs: pd.DataFrame
    """A row a training seed, and a row without numbers for each cell without records; columns `CSV_COLUMNS`, `plans`,
    `led_by_plan` [%] and `outcomes`."""
    notes: tuple[str, ...]
    """Records that were left out or are mixed."""
    number: str = "1"
    """Of the paper's table."""

    @property
    def presets(self) -> list[str]:
        """Presets in the table."""
        return list(dict.fromkeys(self.runs["preset"]))

    def of(self, preset: str) -> pd.DataFrame:
        """The rows of one preset."""
        return self.runs[self.runs["preset"] == preset]


def gather(root: Path, episodes: int, presets: Sequence[str] = ("default",), number: str = "1") -> Results:
    """Read all records of the table of that number; it shows `presets` even without records."""
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    for preset in PRESETS:
        for task in TABLES[number]:
            for method in METHOD_ORDER:
                found = list(_runs(Cell(task, method, preset, 0), root, episodes, notes))
                rows += found or [dict(zip(KEY, (task, method, preset), strict=True))]
    runs = pd.DataFrame(rows, columns=[*CSV_COLUMNS, "plans", "led_by_plan", "outcomes"])
    recorded = set(runs[runs["episodes"].notna()]["preset"])
    runs = runs[runs["preset"].isin(recorded | set(presets))].copy()
    for place, row in runs.iterrows():
        rates = runs[(runs[KEY] == row[KEY]).all(axis=1)]["success_percent"].dropna()
        mean, spread = mean_and_spread(list(rates)) if len(rates) else (None, None)
        runs.loc[place, SPREAD] = [len(rates), mean, spread, *_published(row["task"], row["method"])]
    whole = ["train_seed", "episodes", "successes", "seeds", "paper_percent", "paper_deviation_percent"]
    real = [name for name in (*NUMBERS, *SPREAD, *COST) if name not in whole]
    runs = runs.astype(dict.fromkeys(whole, "Int64") | dict.fromkeys(real, float))
    return Results(runs, (*notes, *_mixed_code(runs), *_mixed_checkpoints(runs), *_missing(runs)), number)


def _published(task: str, method: str) -> tuple[int | None, int | None]:
    """The paper's success rate and its deviation [%]; Table 11 has one training."""
    if (task, method) in TABLE_11:
        return 100 * TABLE_11[task, method] // TRIALS_11, None
    return TABLE_1.get((task, method), (None, None))


def _runs(cell: Cell, root: Path, episodes: int, notes: list[str]) -> Iterator[dict[str, Any]]:
    """A row for each training seed with all records of today's config; a note for each of the others."""
    files = sorted(cell.records(root).parent.glob("train*.jsonl"), key=lambda path: (len(path.name), path.name))
    for path in (path for path in files if path.stem.removeprefix("train").isdecimal()):
        run = Cell(cell.task, cell.method, cell.preset, int(path.stem.removeprefix("train")))
        state = look(run, root, episodes)
        if state.problem or state.done < episodes:
            why = state.problem or f"only {state.done} of {episodes} episodes are recorded"
            notes.append(f"{path} is left out: {why}.")
            continue
        records = select(state.records, range(episodes))
        summary = summarise(records)
        yield {
            "task": run.task, "method": run.method, "preset": run.preset, "train_seed": run.seed,
            "episodes": summary.episodes, "successes": summary.successes, "success_percent": 100 * summary.success_rate,
            "wilson_low_percent": 100 * summary.wilson_low, "wilson_high_percent": 100 * summary.wilson_high,
            "mean_steps": summary.mean_steps, "plan_ms_p50": summary.plan_ms_p50, "plan_ms_p95": summary.plan_ms_p95,
            "training_seconds": training_seconds(run), "config_hash": records[0].config_hash,
            "checkpoint": records[0].checkpoint, "code_versions": " ".join(summary.code_versions), "records": str(path),
            "plans": summary.mean_plans, "led_by_plan": 100 * summary.plan_share,
            "outcomes": {(run.seed, record.episode_seed): record.success for record in records}}


def to_csv(results: Results) -> str:
    """A line a training seed; a cell without records has a line without numbers."""
    return results.runs.to_csv(columns=CSV_COLUMNS, index=False, float_format="%.3f", lineterminator="\n")


def success(runs: pd.DataFrame) -> str:
    """`97.0 (91.5 to 99.0)` of one training seed, `95.5 ± 2.1 (2 seeds)` of several [%]."""
    first = runs.iloc[0]
    if first["seeds"] == 0:
        return MISSING
    if first["seeds"] > 1:
        return f"{first['mean_percent']:.1f} ± {first['spread_percent']:.1f} ({first['seeds']} seeds)"
    return f"{first['mean_percent']:.1f} ({first['wilson_low_percent']:.1f} to {first['wilson_high_percent']:.1f})"


def published(task: str, method: str) -> str:
    """`94 ± 3` [%] of the paper, or `14 of 20`; a dash for methods that it lacks."""
    if (task, method) in TABLE_11:
        return f"{TABLE_11[task, method]} of {TRIALS_11}"
    return "{} ± {}".format(*TABLE_1[task, method]) if (task, method) in TABLE_1 else MISSING


def matrix(runs: pd.DataFrame) -> pd.DataFrame:
    """Text of each cell of one preset: methods × tasks."""
    cells = {(task, method): success(group) for (task, method), group in runs.groupby(["task", "method"])}
    return pd.DataFrame({task: {method: cells[task, method] for method in METHOD_ORDER} for task in tasks_of(runs)})


def tasks_of(runs: pd.DataFrame) -> list[str]:
    """Tasks in the order of the table."""
    return list(dict.fromkeys(runs["task"]))


def to_markdown(runs: pd.DataFrame) -> str:
    """Methods × tasks of one preset, the paper's figure below each of ours [%]."""
    cells = matrix(runs)
    for task in cells:
        cells[task] += [f"<br>paper {published(str(task), method)}" for method in cells.index]
    labels = [get_method(method).label.replace("*", r"\*") for method in cells.index]
    cells.index = pd.Index([f"**{label}**" for label in labels], name="method")
    return cells.to_markdown()


def to_latex(runs: pd.DataFrame, preset: str, number: str = "1") -> str:
    """The table in the paper's shape: a row a task with ours, the best in bold, and the paper's below; needs booktabs."""
    ours = matrix(runs).T.map(_latex)
    best = runs.groupby("task")["mean_percent"].max()
    for (task, method), group in runs.groupby(["task", "method"]):
        if group["mean_percent"].iloc[0] == best[task] > 0:
            ours.loc[task, method] = f"\\textbf{{{ours.loc[task, method]}}}"
    paper = pd.DataFrame({method: {f"\\quad paper {task}": _latex(published(task, method)) for task in ours.index}
                          for method in ours.columns})
    both = pd.concat([ours, paper]).loc[[row for task in ours.index for row in (task, f"\\quad paper {task}")]]
    both.columns = pd.Index([_latex(get_method(method).label) for method in both.columns])
    both.index = pd.Index([row if row in ours.index else "\\quad paper" for row in both.index])
    note = (f"% Generated by `velap table {number}` from the episode records, preset {preset}. "
            "Needs \\usepackage{booktabs}.\n")
    return note + both.to_latex(column_format="l" + "c" * both.shape[1])


def _latex(text: str) -> str:
    """Plain text with LaTeX's special characters escaped."""
    for plain, escaped in (("%", r"\%"), ("_", r"\_"), ("±", r"$\pm$"), ("*", r"$^*$"), (MISSING, "--")):
        text = text.replace(plain, escaped)
    return text


def planning(runs: pd.DataFrame) -> pd.DataFrame:
    """Number and cost of VELAP's plans on each task of one preset; means over the training seeds."""
    velap = runs[(runs["method"] == "velap") & runs["episodes"].notna()]
    columns = {"plans": "plans an episode", "led_by_plan": "steps led by a plan [%]", "plan_ms_p50": "plan p50 [ms]",
               "plan_ms_p95": "plan p95 [ms]", "mean_steps": "steps an episode", "training_seconds": "training [min]"}
    means = velap.groupby("task")[list(columns)].mean()
    means["training_seconds"] /= 60
    means = means.rename(columns=columns)
    means = means.reindex([task for task in tasks_of(runs) if task in means.index])
    return means.map(lambda value: MISSING if pd.isna(value) else f"{value:.1f}")


def comparisons(results: Results) -> pd.DataFrame:
    """VELAP against the baseline with the highest mean rate, the first in the paper's order among equals (McNemar)."""
    rows = []
    for preset in results.presets:
        for task in tasks_of(results.of(preset)):
            group = results.of(preset)
            group = group[(group["task"] == task) & group["episodes"].notna()]
            velap = _outcomes(group, "velap")
            rivals = [method for method in METHOD_ORDER if method not in NO_BASELINES
                      and _outcomes(group, method).keys() & velap.keys()]
            if not rivals:
                continue
            rates = group.groupby("method")["mean_percent"].first()
            best = max(rivals, key=lambda method: rates[method])
            test = mcnemar(velap, _outcomes(group, best))
            rows.append({"task": task, "preset": preset, "best baseline": get_method(best).label,
                         "VELAP [%]": f"{rates['velap']:.1f}", "baseline [%]": f"{rates[best]:.1f}", "pairs": test.episodes,
                         "discordant": test.discordant,
                         "only VELAP / only baseline": f"{test.only_first} / {test.only_second}",
                         "p (McNemar, exact)": "< 0.001" if test.p_value < 0.001 else f"{test.p_value:.3f}"})
    return pd.DataFrame(rows)


def _outcomes(runs: pd.DataFrame, method: str) -> Episodes:
    """Success of every episode of a method, all training seeds of these rows."""
    return {key: won for outcomes in runs[runs["method"] == method]["outcomes"] for key, won in outcomes.items()}


def _mixed_code(runs: pd.DataFrame) -> Iterator[str]:
    """Files with episodes of several versions of the code, or of uncommitted code."""
    recorded = runs[runs["episodes"].notna()]
    versions_of = dict(zip(recorded["records"], recorded["code_versions"], strict=True))
    for path, versions in versions_of.items():
        if " " in versions:
            yield (f"{path} holds episodes of {len(versions.split())} versions of the code: "
                   f"{', '.join(versions.split())}.")
    dirty = [path for path, versions in versions_of.items() if ".dirty" in versions]
    if dirty:
        yield (f"{len(dirty)} files were recorded, wholly or in part, with uncommitted changes of the code: "
               f"{', '.join(dirty)}.")


def _mixed_checkpoints(runs: pd.DataFrame) -> Iterator[str]:
    """Methods of one task, preset and training seed with different joint checkpoints."""
    recorded = runs[runs["episodes"].notna() & (runs["method"] != "random")]
    for (task, preset, seed), group in recorded.groupby(["task", "preset", "train_seed"], sort=False):
        by: dict[str, list[str]] = {}
        for method, checkpoint in zip(group["method"], group["checkpoint"], strict=True):
            weights = _shared(Cell(task, method, preset, int(seed)), checkpoint)
            if weights:
                by.setdefault(weights, []).append(method)
        if len(by) > 1:
            yield (f"{task} {preset} seed {seed}: the methods do not share one joint checkpoint: "
                   + "; ".join(f"{weights[:12]} {', '.join(methods)}" for weights, methods in sorted(by.items())) + ".")


def _shared(cell: Cell, checkpoint: str) -> str:
    """Hash of the weights that a method shares with the others; empty if the checkpoint is missing.

    VELAP's records hold the hash of all of its weights, some of which are its own.
    """
    if not get_method(cell.method).whole_checkpoint:
        return checkpoint
    metadata = cell.joint
    if metadata is None:
        return ""
    return shared_weights(metadata) if metadata.get(WEIGHTS_SHA256) == checkpoint else checkpoint


def _missing(runs: pd.DataFrame) -> Iterator[str]:
    """Number of empty cells of each preset."""
    for preset, group in runs.groupby("preset", sort=False):
        empty = int((group["seeds"] == 0).sum())
        if empty:
            total = len(group.drop_duplicates(KEY))
            yield f"{empty} of {total} cells of preset {preset} are not measured."
