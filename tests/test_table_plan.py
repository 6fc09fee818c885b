"""The plan of `velap table 1`: cells, jobs in order, what has to run, how long it takes; and what is found on disk."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
from rich.console import Console

from studies import forecast, jobs_view
from studies.forecast import Forecast
from studies.inventory import checkpoint_metadata, checkpoint_path
from studies.jobs import Job, Options, make_plan
from studies.matrix import Cell, Selection, everything, parse_only
from studies.paper import METHODS, TABLE_1
from studies.schedule import Schedule, makespan
from studies.table_command import TableOne
from studies.timings import Timing, Timings
from table_cells import Pretended, fill, inventory
from velap import cli
from velap.config import override
from velap.errors import ConfigError, UnknownTaskError
from velap.methods.base import learning_methods
from velap.models.velap import WEIGHTS_SHA256, LatentModel, Spaces, save_checkpoint
from velap.tasks import make_config

SPIRAL = Cell("SpiralMaze", "velap", "default", 0)
PLAIN = Options()


@pytest.fixture(autouse=True)
def _in_a_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


def test_the_papers_table_is_whole() -> None:
    assert len(TABLE_1) == 54
    assert (TABLE_1["SpiralMaze", "velap"].mean, TABLE_1["SpiralMaze", "velap"].deviation) == (94, 3)
    assert (TABLE_1["ButtonWall", "mppi"].mean, TABLE_1["ButtonWall", "mppi"].deviation) == (9, 10)
    assert set(METHODS) <= set(everything().methods)


def test_only_picks_cells_and_leaves_the_other_axes_alone() -> None:
    assert parse_only([]) == everything()
    chosen = parse_only(["task=SpiralMaze", "method=velap,bc", "seed=0,2"])
    assert chosen == Selection(("SpiralMaze",), ("bc", "velap"), ("default",), (0, 2))
    assert [str(cell) for cell in chosen.cells()] == [
        "SpiralMaze bc default seed 0", "SpiralMaze velap default seed 0", "SpiralMaze bc default seed 2",
        "SpiralMaze velap default seed 2"]
    random = parse_only(["task=SpiralMaze", "method=random", "seed=1,2"])
    assert [cell.seed for cell in random.cells()] == [0], "it learns nothing"


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


def test_a_chain_is_dataset_joint_head_evaluation() -> None:
    plan = make_plan([Cell("SpiralMaze", "iql", "paper", 3)], Pretended(), PLAIN)
    where = "SpiralMaze iql paper seed 3"
    assert [(job.name, job.needs) for job in plan] == [
        ("dataset SpiralMaze", ()),
        ("joint SpiralMaze paper seed 3", ("dataset SpiralMaze",)),
        (f"head {where}", ("dataset SpiralMaze", "joint SpiralMaze paper seed 3")),
        (f"evaluate {where}", ("joint SpiralMaze paper seed 3", f"head {where}"))]
    assert [" ".join(job.command) for job in plan] == [
        "collect SpiralMaze", "train SpiralMaze --preset paper --seed 3 --resume",
        "train SpiralMaze --method iql --preset paper --seed 3 --resume",
        "evaluate SpiralMaze --method iql --checkpoint runs/SpiralMaze/paper/seed3/model.safetensors --batch 1"]
    (only,) = make_plan([Cell("SpiralMaze", "random", "paper", 0)], Pretended(), Options(Path("r"), 7, 2))
    assert " ".join(only.command) == "evaluate SpiralMaze --method random --preset paper --episodes 7 --batch 2 --records r"


def test_a_plan_holds_each_job_once_and_after_what_it_needs() -> None:
    cells = everything().cells()
    plan = make_plan(cells, Pretended(), PLAIN)
    tasks, heads = len(everything().tasks), len(learning_methods())
    assert len(plan) == tasks + tasks + tasks * heads + len(cells)
    seen: set[str] = set()
    for job in plan:
        assert set(job.needs) <= seen
        seen.add(job.name)
    assert len(seen) == len(plan)


@pytest.mark.parametrize(("finished", "wanted"), [
    ([], {"dataset", "joint", "head", "evaluate"}),
    (["evaluate"], set()),
    (["head"], {"evaluate", "joint", "dataset"}),
    (["joint"], {"evaluate", "head", "dataset"}),
    (["head", "joint"], {"evaluate"}),
    (["dataset", "joint"], {"evaluate", "head"}),
])
def test_only_what_a_missing_evaluation_needs_has_to_run(finished: list[str], wanted: set[str]) -> None:
    plan = make_plan([Cell("SpiralMaze", "bc", "default", 0)], Pretended(finished), PLAIN)
    assert {job.kind for job in plan if job.wanted} == wanted


def jobs(**needs: str) -> list[Job]:
    """Jobs named by letters, each with the letters that it needs."""
    found = Pretended().look("evaluate", SPIRAL)
    return [Job(name, "evaluate", SPIRAL, tuple(letters), (), found, wanted=True) for name, letters in needs.items()]


def test_the_longest_way_goes_first_and_the_time_is_foretold() -> None:
    plan = jobs(a="", d="", b="a", c="a")
    seconds = {"a": 3.0, "b": 2.0, "c": 4.0, "d": 1.0}
    schedule = Schedule(plan, seconds)
    assert [schedule.next().name, schedule.next().name, schedule.next()] == ["a", "d", None]
    schedule.finish("a")
    assert [schedule.next().name, schedule.next().name] == ["c", "b"]
    assert makespan(plan, seconds, 2) == 7.0
    assert makespan(plan, seconds, 1) == 10.0


def test_a_failure_skips_all_that_need_it_and_nothing_else() -> None:
    schedule = Schedule(jobs(a="", b="a", c="b", d="", e="cd"), dict.fromkeys("abcde", 1.0))
    assert schedule.next().name == "a"
    assert [job.name for job in schedule.fail("a")] == ["b", "c", "e"]
    assert schedule.next().name == "d"
    assert schedule.waiting == 0


def timing(job: str, seconds: float, units: int, unit: str = "units", identity: str = "x", machine: str = "m") -> Timing:
    return Timing(job, seconds, units, unit, identity, 1, 2, machine, "2026-01-01T00:00:00+00:00", "velap", "0.1.0")


def test_sittings_add_up_and_another_config_starts_anew() -> None:
    path = Path("results/timings.json")
    Timings(path).add(timing("a", 10.0, 4))
    Timings(path).add(timing("a", 5.0, 1))
    Timings(path).add(timing("a", 50.0, 0))
    assert [(entry.seconds, entry.units, entry.rate) for entry in Timings(path)] == [(15.0, 5, 3.0)]
    Timings(path).add(timing("a", 8.0, 2, identity="y"))
    assert [(entry.seconds, entry.units) for entry in Timings(path)] == [(8.0, 2)]
    path.write_text("[1]")
    with pytest.raises(Exception, match="does not hold the timings"):
        Timings(path)


def test_a_forecast_takes_the_measured_rate_and_corrects_its_kin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecast, "calibrated", lambda job: 200.0 if job.cell.task == "SpiralMaze" else 100.0)
    cells = [Cell(task, method, "default", 0) for task in ("SpiralMaze", "ObstacleMaze") for method in ("td3bc", "velap")]
    partly = {"evaluate SpiralMaze td3bc default seed 0": (25, 100)}
    plan = make_plan(cells, Pretended(["dataset", "joint"], partly), PLAIN)
    timings = Timings(Path("results/timings.json"))
    timings.add(timing("evaluate SpiralMaze td3bc default seed 0", 100.0, 25))
    timings.add(timing("evaluate ObstacleMaze velap default seed 0", 1e6, 1, machine="another"))
    expect = Forecast(plan, timings, "m")
    by_name = {job.name: job for job in plan}
    measured, kin, other = (by_name[f"evaluate {name} default seed 0"]
                            for name in ("SpiralMaze td3bc", "ObstacleMaze td3bc", "ObstacleMaze velap"))
    assert (expect(measured).seconds, expect(measured).source, expect.left(measured)) == (400.0, "measured", 300.0)
    assert (expect.foretold(measured).seconds, expect.foretold(measured).source) == (200.0, "calibrated")
    assert (expect(kin).seconds, expect(kin).source) == (200.0, "scaled"), "twice its calibrated cost, like the measured one"
    assert (expect(other).seconds, expect(other).source) == (100.0, "calibrated"), "another machine says nothing"
    # Left: 300 + 200 (velap, Spiral) + 200 + 100 on two places, the longest first: 300 + 100 beside 200 + 200.
    # From nothing: 200 + 200 + 400 (td3bc, Spiral) beside all the others.
    lines = jobs_view.totals(plan, expect, "these", 2, 2)
    assert lines == [
        "these: 8 jobs, 4 done, 4 to run in about 7 min; from nothing 13 min. 2 at once on 2 cores.",
        "Measured jobs: 1, which took 7 min where 3 min were foretold; 0 of them are within a third."]


def test_the_whole_table_is_within_its_budget() -> None:
    chosen = dataclasses.replace(everything(), methods=METHODS)
    plan = make_plan(chosen.cells(), inventory(100), PLAIN)
    expect = Forecast(plan, Timings(Path("results/timings.json")), "nowhere")
    assert 1 < jobs_view.whole_hours(plan, expect, 2) <= forecast.BUDGET_HOURS
    assert 1 < jobs_view.whole_hours(plan, expect, 1) <= forecast.BUDGET_HOURS


def test_a_dry_run_says_what_is_there_and_leaves_everything_alone() -> None:
    fill(Cell("SpiralMaze", "random", "default", 0), [False] * 4)
    fill(Cell("SpiralMaze", "td3bc", "default", 0), [True] * 3)
    fill(SPIRAL, [True] * 4, config_hash="0123456789ab")
    before = sorted(Path("results").rglob("*"))
    console = Console(width=200, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    TableOne(parse_only(["task=SpiralMaze", "method=velap,td3bc,random"]), Options(episodes=4)).dry_run(console)
    text = " ".join(console.export_text().split())
    assert "evaluate SpiralMaze random default seed 0 │ done" in text
    assert "evaluate SpiralMaze td3bc default seed 0 │ 3 of 4 episodes" in text
    assert "outdated: its `config_hash` is 0123456789ab, that of today" in text
    assert "3 methods × 1 task × 1 preset × 1 training seed: 5 jobs, 1 done, 4 to run in about" in text
    assert "The paper's table, 9 methods × 6 tasks × 1 preset × 1 training seed, from nothing: " in text
    assert sorted(Path("results").rglob("*")) == before
    assert not Path("docs").exists() and not Path("runs").exists()


def test_a_head_is_expected_to_take_as_long_as_its_data() -> None:
    def updates(text: str) -> int:
        return inventory().head(Cell(*text.split(), "default", 0)).total

    assert updates("SpiralMaze bc") == -(-100 * 20_000 // 256)
    assert updates("ObstacleMaze bc") == 20_000, "its hundred passes are more"
    assert 50 < updates("SpiralMaze bc-success") < updates("ObstacleMaze bc-success") < 1_000
    assert updates("SpiralMaze iql") == 15_000


def test_a_run_of_another_config_is_no_joint_checkpoint() -> None:
    folder = checkpoint_path("SpiralMaze", "default", 0).parent
    folder.mkdir(parents=True)
    config = make_config("SpiralMaze")
    found = inventory().joint("SpiralMaze", "default", 0)
    assert (found.done, found.finished, found.problem) == (0, False, "")
    (folder / "config.json").write_text(config.to_json())
    (folder / "metrics.jsonl").write_text('{"step": 50}\n{"step": 100}\n')
    assert inventory().joint("SpiralMaze", "default", 0).done == 100
    changed = json.loads(config.to_json())
    changed["train"]["c1"] = 0.5
    (folder / "config.json").write_text(json.dumps(changed))
    found = inventory().joint("SpiralMaze", "default", 0)
    assert (found.done, found.finished) == (0, False)
    assert f"train.c1 is 0.5 there and {config.train.c1!r} today" in found.problem


def save_untrained(path: Path, seed: int, **changes: dict[str, object]) -> str:
    """A checkpoint of the default config with random weights; returns the hash of its weights."""
    config = override(make_config("SpiralMaze"), **changes)
    model = LatentModel(config.model, Spaces(64, 64, (-1.0,) * 2, (1.0,) * 2), config.train.discount)
    save_checkpoint(path, model, config, {"seed": str(seed), "train_seconds": "90"})
    metadata = checkpoint_metadata(path)
    assert metadata is not None
    return metadata[WEIGHTS_SHA256]


def test_a_released_checkpoint_stands_for_the_joint_training() -> None:
    released = Path("checkpoints/SpiralMaze.safetensors")
    weights = save_untrained(released, seed=0)
    found = inventory().joint("SpiralMaze", "default", 0)
    assert (found.finished, found.seconds) == (True, 90.0)
    assert not inventory().joint("SpiralMaze", "default", 1).finished, "of another training seed"
    assert not inventory().joint("SpiralMaze", "paper", 0).finished
    fill(SPIRAL, [True] * 4, checkpoint=weights)
    assert inventory().evaluation(SPIRAL).finished
    TableOne(parse_only(["task=SpiralMaze", "method=velap"]))._adopt_released()
    assert checkpoint_path("SpiralMaze", "default", 0).read_bytes() == released.read_bytes()
    assert inventory().evaluation(SPIRAL).finished


def test_records_of_another_checkpoint_than_the_one_there_are_outdated() -> None:
    fill(SPIRAL, [True] * 4, checkpoint="0123456789abcdef")
    assert inventory().evaluation(SPIRAL).finished, "no checkpoint is there to compare with"
    path = checkpoint_path("SpiralMaze", "default", 0)
    weights = save_untrained(path, seed=0)
    assert inventory().evaluation(SPIRAL).problem == f"its `checkpoint` is 0123456789ab, that of today {weights[:12]}"
    save_untrained(path, seed=0, planner={"n_iter": 7})
    found = inventory().joint("SpiralMaze", "default", 0)
    assert (found.finished, found.problem, found.done) == (False, "", found.total), "only the file is to be written anew"
    save_untrained(path, seed=0, train={"joint_steps": 7})
    assert "train.joint_steps is 7 there" in inventory().joint("SpiralMaze", "default", 0).problem
