"""`velap study paper`: what is there, which commands run, and what a failure stops."""

from __future__ import annotations

import shlex
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from rich.console import Console

from studies import paper
from studies.paper import PARTS, Part, make_paper, overview
from velap import cli
from velap.errors import VelapError


def part(name: str, command: str, done: int, unit: str = "cells") -> Part:
    return Part(name=name, command=command, hours=4, progress=lambda: (done, 4), unit=unit)


def test_every_measured_table_and_figure_has_a_part() -> None:
    assert {each.name for each in PARTS} == {"Table 1", "Table 11", *(f"Figure {number}" for number in (3, 5, 6, 7, 8))}


def test_a_dry_run_says_what_is_there_and_how_long_the_rest_takes(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    assert cli.main(["study", "paper", "--dry-run"]) == 0
    lines = " ".join(capsys.readouterr().out.split())
    for each in PARTS:
        done, whole = each.progress()
        assert done == 0 and f"| {each.name} | 0 of {whole} {each.unit} | {each.hours:.1f} | velap {each.command} |" in lines
    assert f"| {sum(each.hours for each in PARTS):.1f} | velap study paper |" in lines
    assert list(tmp_path.iterdir()) == []
    text = overview([part("A", "a", 4), part("B", "b", 1)])
    assert "4 of 4 cells" in text and " 3.0 " in text and " 0.0 " in text


def test_parts_run_in_turn_and_a_failure_stops_none(monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []

    def run(words: list[str]) -> int:
        ran.append(" ".join(words))
        return 2 if words[1] == "1" else 0

    monkeypatch.setattr(paper, "run_command", run)
    parts = [part("Table 1", "table 1 --only seed=0", 1), part("Figure 5", "figure 5", 4), part("Figure 7", "figure 7", 0,
                                                                                               "episodes")]
    with pytest.raises(VelapError, match="1 of 3 parts are not whole: Table 1; the others are"):
        make_paper(Console(quiet=True), parts=parts)
    assert ran == ["table 1 --only seed=0", "figure 5 --no-run", "figure 7"]
    ran.clear()
    make_paper(Console(quiet=True), fresh=True, parts=parts[1:])
    assert ran == ["figure 5 --fresh --no-run", "figure 7"]


@pytest.mark.parametrize("each", PARTS, ids=lambda each: each.name)
def test_commands_of_parts_are_understood(each: Part, monkeypatch: pytest.MonkeyPatch) -> None:
    made = MagicMock()
    monkeypatch.setattr("velap.cli.studies._study", lambda name: made)
    monkeypatch.setattr("velap.report.latent_figure.show", made.show)
    assert cli.main(shlex.split(each.command)) == 0
    assert made.mock_calls, "it goes to its study"
    if each.name in ("Figure 5", "Figure 6"):
        assert made.Plan.call_args.kwargs["updates"] == paper.UPDATES and made.Plan.call_args.kwargs["seeds"] == paper.SEEDS
