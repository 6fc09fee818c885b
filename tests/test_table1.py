"""`velap table 1` and `11`: which cells are missing or outdated, the workflow that makes them, and tables against committed
ones."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pytest

from studies.table1 import tables
from studies.table1.cells import (
    METHOD_ORDER,
    TABLES,
    Cell,
    expected_hash,
    file_metadata,
    look,
    note_training,
    outdated,
    parse_only,
    training_seconds,
)
from studies.table1.page import results_page
from studies.table1.paper import METHODS, TABLE_1, TABLE_11
from studies.table1.workflow import to_do
from velap import cli
from velap.config import override
from velap.errors import ConfigError, RecordError, UnknownTaskError
from velap.evaluation.records import Record, RecordFile, RunKey, read_records
from velap.evaluation.summary import mcnemar, mean_and_spread
from velap.models.checkpoint import WEIGHTS_SHA256, save_checkpoint
from velap.models.velap import LatentModel, Spaces
from velap.tasks import get_task, make_config

ROOT = Path(__file__).resolve().parents[1]
RECORDS = Path("results/records")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results, runs and datasets of these tests go into a temporary folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


def spiral(method: str, seed: int = 0, preset: str = "default") -> Cell:
    return Cell("SpiralMaze", method, preset, seed)


def fill(cell: Cell, outcomes: Sequence[bool], *, config_hash: str | None = None, checkpoint: str = "c0ffee",
         code: str = "0.1.0+gabc", plan_ms: tuple[float, ...] = (10.0, 30.0)) -> Path:
    """A record file of the cell, an episode an outcome, as an evaluation would write it today."""
    task = get_task(cell.task)
    key = RunKey(task=cell.task, method=cell.method, preset=cell.preset, train_seed=cell.seed, env=task.env_id,
                 config_hash=config_hash or str(expected_hash(cell)), checkpoint=checkpoint, code_version=code,
                 max_steps=task.max_steps)
    with RecordFile(key.path(RECORDS), key) as file:
        for seed, success in enumerate(outcomes):
            file.append(Record(**vars(key), episode_seed=seed, success=success, steps=100 if success else 300,
                               truncated=not success, plan_ms=plan_ms, plan_steps=50, batch=1, device="cpu"))
    return key.path(RECORDS)


def save_untrained(path: Path, seed: int = 0, **changes: dict[str, object]) -> str:
    """A checkpoint of the default config with random weights; returns the hash of its weights."""
    config = override(make_config("SpiralMaze"), **changes)
    model = LatentModel(config.model, Spaces(64, 64, (-1.0,) * 2, (1.0,) * 2), config.train.discount)
    save_checkpoint(path, model, config, {"seed": str(seed), "train_seconds": "90"})
    return file_metadata(path)[WEIGHTS_SHA256]


# the cells


def test_the_papers_table_is_whole() -> None:
    assert len(TABLE_1) == 54
    assert TABLE_1["SpiralMaze", "velap"] == (94, 3)
    assert TABLE_1["ButtonWall", "mppi"] == (9, 10)
    assert set(METHODS) <= set(METHOD_ORDER)


def test_table_11_is_whole_and_has_its_own_tasks() -> None:
    assert (TABLE_11["Sponge", "velap"], TABLE_11["Sponge", "bc"], TABLE_11["Rope", "iris"]) == (14, 5, 2)
    assert len(TABLE_11) == 8 and {task for task, _ in TABLE_11} == set(TABLES["11"])
    assert {cell.task for cell in parse_only((), "11")} == {"Sponge", "Rope"}
    with pytest.raises(UnknownTaskError, match="unknown task 'SpiralMaze'; expected some of Sponge, Rope"):
        parse_only(["task=SpiralMaze"], "11")


def test_only_picks_cells_and_leaves_the_other_axes_alone() -> None:
    assert len(parse_only()) == len(TABLES["1"]) * len(METHOD_ORDER)
    assert [str(cell) for cell in parse_only(["task=SpiralMaze", "method=velap,bc", "seed=0,2"])] == [
        "SpiralMaze bc default seed 0", "SpiralMaze bc default seed 2", "SpiralMaze velap default seed 0",
        "SpiralMaze velap default seed 2"]
    assert [cell.seed for cell in parse_only(["task=SpiralMaze", "method=random", "seed=1,2"])] == [0], "it learns nothing"


@pytest.mark.parametrize(("filters", "error", "text"), [
    (["SpiralMaze"], ConfigError, "got 'SpiralMaze'; expected AXIS=VALUE"),
    (["tasks=SpiralMaze"], ConfigError, "an axis of task, method, preset, seed"),
    (["task="], ConfigError, "got 'task='"),
    (["seed=0", "seed=1"], ConfigError, "names the axis 'seed' twice"),
    (["seed=-1"], ConfigError, "the seed '-1'"),
    (["task=Spiral"], UnknownTaskError, "unknown task 'Spiral'; expected some of SpiralMaze"),
    (["method=bc,ppo"], UnknownTaskError, "unknown method 'ppo'"),
    (["preset=best"], UnknownTaskError, "unknown preset 'best'; expected some of default, paper"),
])
def test_a_bad_only_says_what_is_expected(filters: list[str], error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text.replace("(", r"\(")):
        parse_only(filters)


def test_a_bad_command_line_exits_2_and_writes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["table", "1", "--only", "task=Nowhere"]) == 2
    assert "unknown task 'Nowhere'" in capsys.readouterr().err
    assert cli.main(["table", "1", "--jobs", "0"]) == 2
    assert "got 0 jobs" in capsys.readouterr().err
    assert cli.main(["table", "--dry-run"]) == 2
    assert "without the number" in capsys.readouterr().err
    assert list(Path().rglob("*")) == []


def test_records_of_another_config_or_head_are_outdated() -> None:
    fill(spiral("td3bc"), [True] * 3)
    assert (look(spiral("td3bc"), RECORDS, 4).done, look(spiral("td3bc"), RECORDS, 4).problem) == (3, "")
    fill(spiral("velap"), [True] * 4, config_hash="0123456789ab")
    state = look(spiral("velap"), RECORDS, 4)
    assert state.done == 0 and state.problem.startswith("its `config_hash` is 0123456789ab, that of today ")
    fill(spiral("bc"), [True] * 4, config_hash="feed")
    assert "cannot be checked: the head that it was made with" in look(spiral("bc"), RECORDS, 4).problem
    cells = [spiral("td3bc"), spiral("velap"), spiral("bc"), spiral("random")]
    assert to_do(cells, RECORDS, 4) == [cells[0], cells[3]], "outdated ones are left alone"
    assert to_do(cells, RECORDS, 4, fresh=True) == cells
    assert to_do(cells, RECORDS, 3) == [cells[3]]


def test_a_released_checkpoint_stands_for_the_joint_training() -> None:
    cell = spiral("velap")
    weights = save_untrained(Path("checkpoints/SpiralMaze.safetensors"))
    assert cell.released == Path("checkpoints/SpiralMaze.safetensors")
    assert spiral("velap", seed=1).released is None and spiral("velap", preset="paper").released is None
    fill(cell, [True] * 4, checkpoint=weights)
    assert look(cell, RECORDS, 4).done == 4
    note_training([cell])
    assert json.loads(Path("results/training.json").read_text()) == {
        "joint SpiralMaze default seed 0": {"seconds": 90.0, "identity": weights}}
    assert (training_seconds(cell), training_seconds(spiral("bc")), training_seconds(spiral("random"))) == (90.0, None, None)


def test_checkpoints_of_another_config_are_outdated() -> None:
    cell = spiral("velap")
    fill(cell, [True] * 4, checkpoint="0123456789abcdef")
    assert look(cell, RECORDS, 4).done == 4, "no checkpoint is there to compare with"
    weights = save_untrained(cell.checkpoint)
    assert list(outdated(cell)) == []
    assert look(cell, RECORDS, 4).problem == f"its `checkpoint` is 0123456789ab, that of today {weights[:12]}"
    save_untrained(cell.checkpoint, planner={"n_iter": 7})
    assert list(outdated(cell)) == [(cell.checkpoint, "the checkpoint holds another planner or controller than today's")]
    save_untrained(cell.checkpoint, train={"joint": {"c1": 0.5}})
    ((path, reason),) = outdated(cell)
    assert path == cell.checkpoint.parent and "train.joint.c1 is 0.5 there" in reason


# the tables


@pytest.mark.parametrize("number", TABLES)
def test_the_tables_are_those_that_are_committed_cell_by_cell(number: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    results = tables.gather(RECORDS, 100, number=number)
    ours, committed = (pd.read_csv(file) for file in (io.StringIO(tables.to_csv(results)), f"results/table{number}.csv"))
    pd.testing.assert_frame_equal(ours, committed)
    for preset in results.presets:
        written = Path(f"results/table{number}-{preset}.tex").read_text()
        assert tables.to_latex(results.of(preset), preset, number) == written


def test_mcnemar_is_the_exact_binomial_test_of_the_discordant_pairs() -> None:
    def outcomes(text: str, seed: int = 0) -> dict[tuple[int, int], bool]:
        return {(seed, episode): letter == "1" for episode, letter in enumerate(text)}

    test = mcnemar(outcomes("1111111101" + "11"), outcomes("0000000010" + "11"))
    assert (test.episodes, test.only_first, test.only_second, test.discordant) == (12, 9, 1, 10)
    assert test.p_value == pytest.approx(2 * (1 + 10) / 2**10)
    assert mcnemar(outcomes("111111110"), outcomes("000000001")).p_value == pytest.approx(0.0390625), "2 (1 + 9) / 2^9"
    equal = mcnemar(outcomes("1100"), outcomes("1100"))
    assert (equal.discordant, equal.p_value) == (0, 1.0)
    assert mcnemar(outcomes("11", seed=0) | outcomes("11", seed=1), outcomes("0011", seed=1)).episodes == 2
    with pytest.raises(RecordError, match="no episode of the same training and episode seed"):
        mcnemar(outcomes("1", seed=0), outcomes("1", seed=1))


def test_the_spread_is_the_sample_deviation_over_training_seeds() -> None:
    assert mean_and_spread([90.0, 100.0, 95.0]) == (95.0, 5.0)
    mean, spread = mean_and_spread([40.0])
    assert mean == 40.0
    assert math.isnan(spread)


def test_cells_show_intervals_of_one_seed_and_the_spread_of_several() -> None:
    fill(spiral("velap"), [True, True, True, False])
    fill(spiral("velap", seed=10), [True] * 4, plan_ms=(30.0, 50.0))
    fill(spiral("td3bc"), [True, False, False, False], plan_ms=())
    results = tables.gather(RECORDS, 4)
    cells = tables.matrix(results.of("default"))["SpiralMaze"]
    assert cells["velap"] == "87.5 ± 17.7 (2 seeds)", "75 and 100: deviation 25 / √2"
    assert cells["td3bc"] == "25.0 (4.6 to 69.9)", "Wilson interval of 1 of 4"
    assert cells["iql"] == "–", "missing, not guessed"
    text = " ".join(tables.to_markdown(results.of("default")).split())
    assert "87.5 ± 17.7 (2 seeds)<br>paper 94 ± 3" in text and "**IQL (0.9 / 10)** | –<br>paper –" in text
    assert r"**BC (D\*)** |" in text, "the asterisk of a name is no mark of Markdown"
    costs = tables.planning(results.of("default")).loc["SpiralMaze"]
    assert tuple(costs)[:4] == ("2.0", "41.7", "30.0", "40.0"), "medians 20 and 40; 95th percentiles 30 and 50"
    rows = list(csv.DictReader(io.StringIO(tables.to_csv(results))))
    velap = [row for row in rows if (row["task"], row["method"]) == ("SpiralMaze", "velap")]
    assert [(row["train_seed"], row["success_percent"], row["mean_percent"], row["spread_percent"]) for row in velap] == [
        ("0", "75.000", "87.500", "17.678"), ("10", "100.000", "87.500", "17.678")]
    assert (velap[0]["wilson_low_percent"], velap[0]["wilson_high_percent"]) == ("30.064", "95.441")
    (missing,) = [row for row in rows if (row["task"], row["method"]) == ("DrawerButton", "iris")]
    assert [missing[name] for name in ("paper_percent", "success_percent", "train_seed", "seeds")] == ["5", "", "", "0"]


def test_velap_is_tested_against_the_best_baseline_on_the_same_episodes() -> None:
    fill(spiral("velap"), [True, True, True, False])
    fill(spiral("mppi"), [True, False, False, True])
    fill(spiral("td3bc"), [True, True, False, False])
    fill(spiral("random"), [True, True, True, True])
    (row,) = tables.comparisons(tables.gather(RECORDS, 4)).to_dict("records")
    assert (row["best baseline"], row["VELAP [%]"], row["baseline [%]"]) == ("TD3-BC", "75.0", "50.0"), "first of equals"
    assert (row["pairs"], row["discordant"], row["only VELAP / only baseline"]) == (4, 1, "1 / 0")
    assert row["p (McNemar, exact)"] == "1.000"


def test_what_is_left_out_or_mixed_is_named() -> None:
    other = fill(spiral("velap"), [True] * 4, config_hash="0123456789ab")
    part = fill(spiral("iql"), [True] * 3, config_hash="feed")
    one = fill(spiral("td3bc"), [True] * 4, checkpoint="aaaaaaaaaaaaaaaa", code="0.1.0+g1.dirty")
    two = fill(spiral("mppi"), [True] * 4, checkpoint="bbbbbbbbbbbbbbbb")
    few = fill(spiral("mbop"), [True] * 3)
    lines = two.read_text().splitlines(keepends=True)
    two.write_text(lines[0].replace("gabc", "gdef") + "".join(lines[1:]))
    results = tables.gather(RECORDS, 4)
    assert set(results.runs["records"].dropna()) == {str(one), str(two)}
    notes = "\n".join(results.notes)
    assert f"{other} is left out: its `config_hash` is 0123456789ab, that of today " in notes
    assert f"{part} is left out: its `config_hash` cannot be checked" in notes
    assert f"{few} is left out: only 3 of 4 episodes are recorded." in notes
    assert f"1 files were recorded, wholly or in part, with uncommitted changes of the code: {one}." in notes
    assert f"{two} holds episodes of 2 versions of the code: 0.1.0+gabc, 0.1.0+gdef." in notes
    assert ("SpiralMaze default seed 0: the methods do not share one joint checkpoint: aaaaaaaaaaaa td3bc; "
            "bbbbbbbbbbbb mppi.") in notes


def test_where_nothing_is_measured_no_cell_has_a_number() -> None:
    results = tables.gather(RECORDS, 4)
    assert set(tables.matrix(results.of("default")).to_numpy().ravel()) == {"–"}
    assert f"{len(parse_only())} of {len(parse_only())} cells of preset default are not measured." in results.notes
    assert "## VELAP against" not in results_page(results, 4)


def test_the_page_and_the_files_are_written_from_the_records(capsys: pytest.CaptureFixture[str]) -> None:
    fill(spiral("random"), [False] * 4)
    fill(spiral("velap"), [True] * 4, config_hash="0123456789ab")
    command = ["table", "1", "--no-run", "--episodes", "4"]
    assert cli.main(command) == 0
    page = Path("docs/results.md").read_text()
    assert "0.0 (0.0 to 49.0)<br>paper –" in page and "–<br>paper 94 ± 3" in page
    assert "its `config_hash` is 0123456789ab" in page
    assert Path("results/table1.csv").read_text().startswith("task,method,preset,train_seed")
    assert Path("results/table1-default.tex").exists()
    assert "note: " in capsys.readouterr().out
    assert cli.main(command) == 0
    assert Path("docs/results.md").read_text() == page, "the same records give the same page"


def test_table_11_stands_beside_the_robots_episodes() -> None:
    sponge = [Cell("Sponge", method, "default", 0) for method in ("velap", "td3bc")]
    fill(sponge[0], [True] * 4)
    fill(sponge[1], [True, False, False, False])
    assert cli.main(["table", "11", "--no-run", "--episodes", "4", "--only", "task=Sponge"]) == 0
    page = Path("docs/table11.md").read_text()
    assert "100.0 (51.0 to 100.0)<br>paper 14 of 20" in page and "–<br>paper 8 of 20" in page
    assert "25.0 (4.6 to 69.9)<br>paper –" in page and "SpiralMaze" not in page
    assert "TD3-BC" in page.split("## VELAP against")[1]
    rows = list(csv.DictReader(Path("results/table11.csv").read_text().splitlines()))
    (row,) = [row for row in rows if (row["task"], row["method"]) == ("Sponge", "velap")]
    assert (row["paper_percent"], row["paper_deviation_percent"], row["success_percent"]) == ("70", "", "100.000")
    assert r"14 of 20" in Path("results/table11-default.tex").read_text()
    assert not Path("results/table1.csv").exists()


# the workflow


def table(*arguments: str) -> subprocess.Popen[str]:
    """`velap table 1` of two cells, in a process of its own."""
    path = os.pathsep.join(entry for entry in sys.path if entry)
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "velap", "table", "1", "--only", "task=SpiralMaze", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


@pytest.mark.timeout(300)
def test_a_dry_run_names_cells_and_jobs_and_leaves_everything_alone() -> None:
    fill(spiral("random"), [False] * 4)
    fill(spiral("td3bc"), [True] * 3)
    fill(spiral("velap"), [True] * 4, config_hash="0123456789ab")
    before = sorted(Path("results").rglob("*"))
    text = table("method=velap,td3bc,random,bc", "--episodes", "4", "--dry-run").communicate()[0]
    lines = " ".join(text.split())
    assert "| SpiralMaze random default seed 0 | done |" in lines
    assert "| SpiralMaze td3bc default seed 0 | 3 of 4 episodes |" in lines
    assert "| SpiralMaze velap default seed 0 | outdated: its `config_hash` is 0123456789ab, that of today" in lines
    assert "collect 1 evaluate 2 head 1 table 1 train 1" in lines, "of td3bc and bc"
    assert sorted(Path("results").rglob("*")) == before
    assert not Path("docs").exists() and not Path("runs/SpiralMaze").exists()


@pytest.mark.timeout(300)
def test_a_terminated_table_goes_on_and_names_what_is_outdated() -> None:
    path = spiral("random").records(RECORDS)
    first = table("method=random,velap", "--episodes", "400")
    while not (path.exists() and path.read_bytes().count(b"\n") >= 2):
        assert first.poll() is None, first.communicate()[0]
        time.sleep(0.05)
    first.send_signal(signal.SIGTERM)
    assert first.wait() == 130, first.communicate()[0]
    time.sleep(0.5)
    torn = path.read_bytes()
    done = torn.count(b"\n")
    assert 2 <= done < 400, "its jobs ended with it"
    fill(spiral("velap"), [True] * 3, config_hash="0123456789ab")
    second = table("method=random,velap", "--episodes", str(done + 2))
    text = " ".join(second.communicate()[0].split())
    assert second.returncode == 2, text
    assert "1 of 2 cells are not done: SpiralMaze velap default seed 0: outdated: its `config_hash`" in text
    assert path.read_bytes().startswith(torn[: torn.rindex(b"\n") + 1]), "what was recorded stays as it is"
    assert [record.episode_seed for record in read_records(path)] == list(range(done + 2))
    assert "<br>paper –" in Path("docs/results.md").read_text()
    assert not Path("runs/table1/done").exists() or not any(Path("runs/table1/done").iterdir())


def test_the_extra_is_asked_for_where_it_is_missing(monkeypatch: pytest.MonkeyPatch,
                                                    capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("studies.table1.workflow.NEEDED", ("snakemake_that_is_not_here", "pandas"))
    assert cli.main(["table", "1", "--dry-run"]) == 2
    assert "needs snakemake_that_is_not_here; expected the extra `studies`" in " ".join(capsys.readouterr().err.split())
