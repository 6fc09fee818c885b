"""What `velap table 1` writes: statistics against hand-computed numbers, Markdown, CSV and LaTeX, and what is left out."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import pytest

from studies.matrix import Cell
from studies.table1 import Results, gather
from studies.table1_text import (
    CSV_COLUMNS,
    markdown_cells,
    markdown_comparisons,
    markdown_matrix,
    p_value,
    plan_time,
    to_csv,
    to_latex,
)
from studies.timings import Timing, Timings
from table_cells import fill, inventory
from velap import cli
from velap.errors import RecordError
from velap.evaluation.statistics import mcnemar, mean_and_spread


@pytest.fixture(autouse=True)
def _in_a_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


def spiral(method: str, seed: int = 0, preset: str = "default") -> Cell:
    return Cell("SpiralMaze", method, preset, seed)


def read() -> Results:
    return gather(inventory(), Timings(Path("results/timings.json")))


def outcomes(text: str, seed: int = 0) -> dict[tuple[int, int], bool]:
    return {(seed, episode): letter == "1" for episode, letter in enumerate(text)}


def test_mcnemar_is_the_exact_binomial_test_of_the_discordant_pairs() -> None:
    test = mcnemar(outcomes("1111111101" + "11"), outcomes("0000000010" + "11"))
    assert (test.episodes, test.only_first, test.only_second, test.discordant) == (12, 9, 1, 10)
    assert test.p_value == pytest.approx(2 * (1 + 10) / 2**10)
    eight_to_one = mcnemar(outcomes("111111110"), outcomes("000000001"))
    assert eight_to_one.p_value == pytest.approx(0.0390625), "2 (1 + 9) / 2^9"
    equal = mcnemar(outcomes("1100"), outcomes("1100"))
    assert (equal.discordant, equal.p_value) == (0, 1.0)


def test_only_shared_episodes_are_paired() -> None:
    first = outcomes("11", seed=0) | outcomes("11", seed=1)
    assert mcnemar(first, outcomes("0011", seed=1)).episodes == 2
    with pytest.raises(RecordError, match="no episode of the same training and episode seed"):
        mcnemar(outcomes("1", seed=0), outcomes("1", seed=1))


def test_the_spread_is_the_sample_deviation_over_training_seeds() -> None:
    assert mean_and_spread([90.0, 100.0, 95.0]) == (95.0, 5.0)
    mean, spread = mean_and_spread([40.0])
    assert mean == 40.0
    assert math.isnan(spread)


def test_cells_show_intervals_of_one_seed_and_the_spread_of_several() -> None:
    fill(spiral("velap"), [True, True, True, False])
    fill(spiral("velap", seed=1), [True, True, True, True], plan_ms=(30.0, 50.0))
    fill(spiral("td3bc"), [True, False, False, False], plan_ms=())
    entries = {entry.method: entry for entry in read().of("default") if entry.task == "SpiralMaze"}
    text = markdown_matrix(tuple(entries.values()))
    assert "| **VELAP** | 87.5 ± 17.7 (2 seeds)<br>paper 94 ± 3 |" in text, "75 and 100: deviation 25 / √2"
    assert "| **TD3-BC** | 25.0 (4.6 to 69.9)<br>paper 0 ± 0 |" in text, "Wilson interval of 1 of 4"
    assert "| **IQL** | –<br>paper 0 ± 0 |" in text, "missing, not guessed"
    assert "| **IQL (0.9 / 10)** | –<br>paper – |" in text
    assert plan_time(entries["velap"]) == "30.0 / 40.0", "medians 20 and 40; 95th percentiles 30 and 50"
    assert plan_time(entries["td3bc"]) == "–"


def test_training_times_add_joint_training_and_head() -> None:
    fill(spiral("td3bc"), [True] * 4)
    timings = Timings(Path("results/timings.json"))

    def note(job: str, seconds: float) -> None:
        timings.add(Timing(job, seconds, 10, "updates", "w", 1, 2, "m", "2026-01-02T00:00:00+00:00", "velap", "v"))

    note("head SpiralMaze bc default seed 0", 60.0)
    fill(spiral("bc"), [False] * 4)
    assert {entry.method: entry.training_seconds for entry in read().entries if entry.runs} == {"td3bc": None, "bc": None}
    note("joint SpiralMaze default seed 0", 600.0)
    assert {entry.method: entry.training_seconds for entry in read().entries if entry.runs} == {"td3bc": 600.0, "bc": 660.0}
    assert "| SpiralMaze | BC | 0 | 0.0 (0.0 to 49.0) | 0 ± 0 | 20.0 / 30.0 | 11.0 |" in markdown_cells(read().of("default"))


def test_velap_is_tested_against_the_best_baseline_on_the_same_episodes() -> None:
    fill(spiral("velap"), [True, True, True, False])
    fill(spiral("mppi"), [True, False, False, True])
    fill(spiral("td3bc"), [True, True, False, False])
    fill(spiral("random"), [True, True, True, True])
    (comparison,) = read().comparisons
    assert (comparison.baseline, comparison.velap_rate, comparison.baseline_rate) == ("td3bc", 75.0, 50.0), "first of equals"
    assert (comparison.test.episodes, comparison.test.discordant, comparison.test.p_value) == (4, 1, 1.0)
    assert "| SpiralMaze | default | TD3-BC | 75.0 | 50.0 | 4 | 1 | 1 / 0 | 1.000 |" in markdown_comparisons([comparison])
    assert [p_value(value) for value in (0.0004, 0.0312)] == ["< 0.001", "0.031"]


def test_records_of_another_config_are_left_out_and_named() -> None:
    kept = fill(spiral("td3bc"), [True] * 4)
    other = fill(spiral("velap"), [True] * 4, config_hash="0123456789ab")
    part = fill(spiral("mppi"), [True] * 3)
    unknown = fill(spiral("bc"), [True] * 4, config_hash="feed")
    results = read()
    assert [run.path for entry in results.entries for run in entry.runs] == [kept]
    notes = "\n".join(results.notes)
    assert f"{other} is left out: its `config_hash` is 0123456789ab, that of today " in notes
    assert f"{part} is left out: only 3 of 4 episodes are recorded." in notes
    assert f"{unknown} is left out: its `config_hash` cannot be checked" in notes
    assert results.comparisons == ()
    assert inventory().evaluation(spiral("velap")).problem.startswith("its `config_hash` is 0123456789ab")
    assert not inventory().evaluation(spiral("velap")).finished


def test_mixed_code_and_mixed_checkpoints_are_named() -> None:
    one = fill(spiral("td3bc"), [True] * 4, checkpoint="aaaaaaaaaaaaaaaa", code="0.1.0+g1.dirty")
    two = fill(spiral("mppi"), [True] * 4, checkpoint="bbbbbbbbbbbbbbbb")
    lines = two.read_text().splitlines(keepends=True)
    two.write_text(lines[0].replace("gabc", "gdef") + "".join(lines[1:]))
    notes = "\n".join(read().notes)
    assert f"1 files were recorded, wholly or in part, with uncommitted changes of the code: {one}." in notes
    assert f"{two} holds episodes of 2 versions of the code: 0.1.0+gabc, 0.1.0+gdef." in notes
    shared = "the methods do not share one joint checkpoint: aaaaaaaaaaaa td3bc; bbbbbbbbbbbb mppi."
    assert f"SpiralMaze default seed 0: {shared}" in notes


def test_the_csv_has_a_line_a_training_seed_and_one_for_a_missing_cell() -> None:
    path = fill(spiral("velap"), [True, True, True, False])
    fill(spiral("velap", seed=10), [True] * 4)
    rows = list(csv.DictReader(io.StringIO(to_csv(read()))))
    assert tuple(rows[0]) == CSV_COLUMNS
    velap = [row for row in rows if (row["task"], row["method"]) == ("SpiralMaze", "velap")]
    assert [(row["train_seed"], row["success_percent"], row["mean_percent"], row["spread_percent"]) for row in velap] == [
        ("0", "75.000", "87.500", "17.678"), ("10", "100.000", "87.500", "17.678")]
    assert (velap[0]["wilson_low_percent"], velap[0]["wilson_high_percent"]) == ("30.064", "95.441")
    assert (velap[0]["paper_percent"], velap[0]["paper_deviation_percent"], velap[0]["records"]) == ("94", "3", str(path))
    (missing,) = [row for row in rows if (row["task"], row["method"]) == ("DrawerButton", "iris")]
    assert [missing[name] for name in ("paper_percent", "success_percent", "train_seed", "seeds")] == ["5", "", "", "0"]


def test_the_latex_table_has_the_papers_shape() -> None:
    fill(spiral("velap"), [True, True, True, False])
    fill(spiral("td3bc"), [False] * 4)
    lines = to_latex(read(), "default").splitlines()
    header = next(line for line in lines if "VELAP" in line and line.endswith(r"\\"))
    columns = header.count("&")
    assert f"\\begin{{tabular}}{{l{'c' * columns}}}" in lines
    assert r"BC (D$^*$)" in header
    rows = [line for line in lines if line.endswith(r"\\") and line != header]
    assert len(rows) == 12, "six tasks, ours and the paper's"
    assert {line.count("&") for line in rows} == {columns}
    assert rows[0].startswith("SpiralMaze & -- & -- & 0.0 (0.0 to 49.0) & ")
    assert r"\textbf{75.0 (30.1 to 95.4)}" in rows[0]
    assert rows[1].startswith(r"\quad paper & 0 $\pm$ 0 & ")
    assert r"94 $\pm$ 3" in rows[1]
    assert all(line.count("{") == line.count("}") for line in lines)


def test_the_page_and_the_files_are_written_from_the_records(capsys: pytest.CaptureFixture[str]) -> None:
    path = fill(spiral("random"), [False] * 4)
    fill(spiral("velap"), [True] * 4, config_hash="0123456789ab")
    assert cli.main(["table", "1", "--no-run", "--episodes", "4"]) == 0
    page = Path("docs/results.md").read_text()
    assert "| **random** | 0.0 (0.0 to 49.0)<br>paper – |" in page
    assert "| **VELAP** | –<br>paper 94 ± 3 |" in page
    assert "its `config_hash` is 0123456789ab" in page
    assert f"| `{path}` | 0.0 (0.0 to 49.0) |" in page
    assert "velap evaluate SpiralMaze --method random --preset default --episodes 4 --batch 1" in page
    assert "velap train SpiralMaze --method iql --preset default --seed 0 --resume" in page
    assert Path("results/table1.csv").read_text().startswith("task,method,preset,train_seed")
    assert Path("results/table1-default.tex").exists()
    assert "note: " in capsys.readouterr().out
    first = page
    assert cli.main(["table", "1", "--no-run", "--episodes", "4"]) == 0
    assert Path("docs/results.md").read_text() == first, "the same records give the same page"
