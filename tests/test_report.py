"""Statistics against hand-computed numbers; tables from records alone."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest

from test_records import KEY, record
from velap.errors import RecordError
from velap.evaluation.records import RecordFile
from velap.evaluation.summary import (
    TABLE_END,
    TABLE_START,
    markdown_table,
    summarise,
    summarise_all,
    summary_text,
    wilson,
    write_into,
)


@pytest.mark.parametrize(("successes", "episodes"), [(99, 100), (0, 100), (10, 10), (3, 7)])
def test_wilson_interval_is_the_formula(successes: int, episodes: int) -> None:
    z, p = 1.959963984540054, successes / episodes
    centre = (p + z**2 / (2 * episodes)) / (1 + z**2 / episodes)
    half = z / (1 + z**2 / episodes) * math.sqrt(p * (1 - p) / episodes + z**2 / (4 * episodes**2))
    assert wilson(successes, episodes) == pytest.approx((centre - half, centre + half), abs=1e-12)


def test_summary_counts_every_record() -> None:
    records = [
        dataclasses.replace(record(0), steps=100, plan_ms=(1.0, 2.0)),
        dataclasses.replace(record(1), steps=200, plan_ms=(3.0,)),
        dataclasses.replace(record(2, success=False), steps=300, plan_ms=(4.0, 5.0), code_version="0.1.1"),
    ]
    summary = summarise(records)
    assert (summary.episodes, summary.successes) == (3, 2)
    assert summary.success_rate == pytest.approx(2 / 3)
    assert summary.mean_steps == 200
    assert summary.mean_success_steps == 150
    assert summary.plan_ms_p50 == 3
    assert summary.plan_ms_p95 == pytest.approx(4.8)
    assert summary.code_versions == ("0.1.0", "0.1.1")


def test_nothing_planned_and_nothing_solved_are_defined() -> None:
    summary = summarise([dataclasses.replace(record(0, success=False), plan_ms=())])
    assert math.isnan(summary.plan_ms_p50)
    assert math.isnan(summary.mean_success_steps)
    assert "| 0.0 (0.0 to 79.3) | - / 10.0 | - / - |" in " ".join(markdown_table([summary]).split())
    with pytest.raises(RecordError, match="no records"):
        summarise([])


def fill(root: Path) -> None:
    for method, successes in (("velap", 2), ("random", 0)):
        key = dataclasses.replace(KEY, method=method)
        with RecordFile(key.path(root), key) as file:
            for seed in range(2):
                file.append(dataclasses.replace(record(seed, success=seed < successes), method=method))


def test_tables_come_from_the_record_files(tmp_path: Path) -> None:
    fill(tmp_path)
    (tmp_path / "Maze" / "velap-default" / "train0.jsonl.old-1").write_text("moved aside")
    summaries = summarise_all(tmp_path)
    assert [(s.method, s.successes) for s in summaries] == [("random", 0), ("velap", 2)]
    lines = markdown_table(summaries).splitlines()
    assert len(lines) == 4
    expected = "| Maze | velap | default | 0 | 2 | 100.0 (34.2 to 100.0) | 10.0 / 10.0 | 1.9 / 2.2 |"
    assert " ".join(lines[3].split()) == expected
    assert len({len(line) for line in lines}) == 1, "columns stand below each other"
    text = summary_text(summaries[1])
    assert "success [%] (95 % interval)  100.0 (34.2 to 100.0)" in text and "plan p50 / p95 [ms]" in text
    with pytest.raises(RecordError, match="no records below"):
        summarise_all(tmp_path / "nowhere")


def test_a_document_gets_its_table_replaced(tmp_path: Path) -> None:
    document = tmp_path / "README.md"
    document.write_text(f"before\n{TABLE_START}\nold\n{TABLE_END}\nafter\n")
    write_into(document, "| new |")
    write_into(document, "| newer |")
    assert document.read_text() == f"before\n{TABLE_START}\n| newer |\n{TABLE_END}\nafter\n"
    document.write_text("no marks")
    with pytest.raises(RecordError, match="no place for the table"):
        write_into(document, "| new |")
