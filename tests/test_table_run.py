"""Running the plan of `velap table 1`: children, failures, interruptions, and what a killed evaluation loses."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from rich.console import Console

from studies import table_command
from studies.children import Child
from studies.inventory import Finding
from studies.jobs import Job, Options
from studies.jobs_view import JobsView
from studies.matrix import Cell, parse_only
from studies.runner import Outcome, Runner
from studies.schedule import Schedule
from studies.table_command import Places, TableOne
from studies.timings import Timings
from table_cells import fill, inventory
from velap import cli
from velap.errors import RecordError, VelapError
from velap.evaluation.records import read_records

RANDOM = Cell("SpiralMaze", "random", "default", 0)
LOGS = Path("runs/table")

LIGHT = """
import os, sys, time
from studies.children import follow_parent
follow_parent()
"""
"""Start of a child that loads nothing heavy."""
WORK = LIGHT + """
name, what = sys.argv[1:]
if what == "fail":
    sys.exit("velap: no luck")
print(f"doing {name}: 1 of 2  threads {os.environ['OMP_NUM_THREADS']}", flush=True)
if what == "wait":
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        open(name + ".saved", "w").close()
        sys.exit(130)
open(name, "w").close()
"""
"""A child that makes the file of its name, fails, or waits to be interrupted."""


@pytest.fixture(autouse=True)
def _in_a_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


class Seen:
    """Notes what the runner tells its observer."""

    def __init__(self, stop_after: str = "") -> None:
        self.events: list[str] = []
        self._awaited = set(stop_after)
        """Names of jobs; SIGTERM once all of them have reported progress."""

    def started(self, job: Job, log: Path) -> None:
        self.events.append(f"started {job.name}")

    def progress(self, job: Job, done: int, total: int, text: str) -> None:
        self.events.append(f"{job.name} {done}/{total} {text}")
        if job.name in self._awaited:
            self._awaited.discard(job.name)
            if not self._awaited:
                os.kill(os.getpid(), signal.SIGTERM)

    def finished(self, job: Job, seconds: float) -> None:
        self.events.append(f"finished {job.name}")

    def failed(self, job: Job, reason: str) -> None:
        self.events.append(f"failed {job.name}: {reason}")

    def skipped(self, job: Job, because: Job) -> None:
        self.events.append(f"skipped {job.name} for {because.name}")


def work(name: str, what: str = "work", needs: str = "") -> Job:
    return Job(name, "evaluate", RANDOM, tuple(needs), (name, what), Finding(0, 1, "files", False), wanted=True)


def there(job: Job) -> Finding:
    made = Path(job.name).exists()
    return Finding(int(made), 1, "files", made)


def run(jobs: list[Job], seen: Seen, places: int = 2, sittings: list[tuple[str, int]] | None = None) -> Outcome:
    runner = Runner(lambda job: job.command, there,
                    lambda job, seconds, units: (sittings if sittings is not None else []).append((job.name, units)),
                    seen, places, 3, LOGS, WORK)
    return runner.run(Schedule(jobs, {job.name: 1.0 for job in jobs}))


def test_a_failure_is_told_and_only_what_needs_it_is_skipped() -> None:
    seen, sittings = Seen(), list[tuple[str, int]]()
    outcome = run([work("a", "fail"), work("d"), work("b", needs="a"), work("c", needs="bd"), work("e", needs="d")], seen,
                  sittings=sittings)
    assert (sorted(outcome.finished), list(outcome.failed), outcome.skipped) == (["d", "e"], ["a"], ["b", "c"])
    assert outcome.failed["a"] == "no luck (exit code 1; all it said is in runs/table/a.log)"
    assert seen.events.index("finished d") < seen.events.index("started e")
    assert {"skipped b for a", "skipped c for a"} <= set(seen.events)
    assert sorted(sittings) == [("a", 0), ("d", 1), ("e", 1)]
    assert (LOGS / "d.log").read_text() == "doing d: 1 of 2  threads 3\n"


def test_no_more_jobs_run_at_once_than_there_are_places() -> None:
    seen = Seen()
    run([work("a"), work("b"), work("c")], seen, places=1)
    running = 0
    for event in seen.events:
        running += event.startswith("started") - event.startswith("finished")
        assert running <= 1
    assert sum(event.startswith("finished") for event in seen.events) == 3


def test_a_job_that_ends_well_and_left_nothing_has_failed() -> None:
    runner = Runner(lambda job: ("elsewhere", "work"), there, lambda job, seconds, units: None, Seen(), 1, 1, LOGS, WORK)
    outcome = runner.run(Schedule([work("a")], {"a": 1.0}))
    assert list(outcome.failed) == ["a"]


def test_ctrl_c_lets_the_children_save_and_ends_them() -> None:
    seen, sittings = Seen(stop_after="ab"), list[tuple[str, int]]()
    with pytest.raises(KeyboardInterrupt):
        run([work("a", "wait"), work("b", "wait"), work("c")], seen, sittings=sittings)
    assert Path("a.saved").exists() and Path("b.saved").exists() and not Path("c").exists()
    assert "a 1/2 threads 3" in seen.events
    assert sorted(sittings) == [("a", 0), ("b", 0)]


def test_children_do_not_outlive_a_killed_parent() -> None:
    code = ("import sys, time; from pathlib import Path; from studies.children import Child\n"
            f"child = Child(['a', 'wait'], Path('log'), 1, {WORK!r}); print(child.pid, flush=True); time.sleep(60)")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    deadline = time.monotonic() + 60
    while not Path("log").read_text() and time.monotonic() < deadline:
        time.sleep(0.02)
    parent.kill()
    parent.communicate()
    while not Path("a.saved").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert Path("a.saved").exists(), "told to save"
    while time.monotonic() < deadline:
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{child}/stat").exists() and " Z " in Path(f"/proc/{child}/stat").read_text():
            return
        time.sleep(0.02)
    pytest.fail("the child is still there")


def test_the_last_progress_line_counts() -> None:
    child = Child(["a", "work"], Path("log"), 1, WORK)
    child.end()
    assert child.progress() == (1, 2, "threads 1")
    Path("log").write_text("training, joint phase: 50 of 8000  loss 0.1\ntraining, joint phase: 100 of 8000\nnote: x\n")
    assert child.progress() == (100, 8000, "")
    assert child.last_words() == "note: x"


def test_plain_lines_where_the_output_is_no_terminal() -> None:
    from studies.forecast import Forecast

    found = Finding(1, 4, "episodes", False)
    job = Job("evaluate it", "evaluate", RANDOM, (), ("evaluate", "SpiralMaze"), found, wanted=True)
    other = Job(**{**vars(job), "name": "evaluate that"})
    with open("out", "w") as file:
        view = JobsView(Console(file=file, width=80), [job, other], Forecast([job, other], Timings(Path("t")), "m"), 2)
        with view:
            view.started(job, Path("log"))
            view.finished(job, 12.0)
            view.skipped(other, job)
    lines = Path("out").read_text().splitlines()
    assert lines[0].startswith("started evaluate it, about ") and lines[0].endswith(": velap evaluate SpiralMaze")
    assert lines[1:] == ["finished evaluate it in 12 s", "skipped evaluate that: it needs evaluate it"]


def table(code: str | None = None, fresh: bool = False) -> TableOne:
    """`velap table 1 --only task=SpiralMaze method=random --episodes 5`."""
    chosen = parse_only(["task=SpiralMaze", "method=random"])
    extra = {} if code is None else {"code": code}
    return TableOne(chosen, Options(episodes=5), Places(), 2, fresh, **extra)


def test_a_second_table_waits_for_the_jobs_of_a_killed_one_and_then_gives_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_command, "WAIT_SECONDS", 1.5)
    lock = LOGS / "lock"
    lock.parent.mkdir(parents=True)
    console = Console(file=open(os.devnull, "w"))  # noqa: SIM115
    with table_command._only_one(lock, console) as held:
        child = Child(["a", "wait"], Path("log"), 1, WORK, (held,))
    with pytest.raises(VelapError, match="another `velap table 1` is running here"), table_command._only_one(lock, console):
        pass
    monkeypatch.setattr(table_command, "WAIT_SECONDS", 60.0)
    threading.Timer(0.5, child.stop).start()
    with table_command._only_one(lock, console):
        assert child.poll() is not None
    child.end()


DIES = """
import os, signal, sys
from velap.evaluation import records
whole = records.os.fsync
count = 0
def fsync(descriptor):
    global count
    count += 1
    if count == 4:
        os.ftruncate(descriptor, os.fstat(descriptor).st_size - 9)  # the disk has a part of the line
        os.kill(os.getpid(), signal.SIGKILL)
    whole(descriptor)
os.fsync = fsync
from velap.cli import main
sys.exit(main())
"""
"""`velap`, killed while the fourth record is being written."""


@pytest.mark.timeout(300)  # two starts of the whole package, on whatever else runs
def test_a_killed_evaluation_loses_one_episode_at_most() -> None:
    quiet = Console(file=open(os.devnull, "w"))  # noqa: SIM115
    path = inventory().record_path(RANDOM)
    with pytest.raises(VelapError, match=r"1 of 1 jobs failed.*killed by signal 9"):
        table(DIES).run(quiet)
    torn = path.read_bytes()
    before = torn[: torn.rindex(b"\n") + 1]
    assert before.count(b"\n") == 3 and not torn.endswith(b"\n")
    assert "only 3 of 5 episodes are recorded" in Path("docs/results.md").read_text()
    (timing,) = Timings(Path("results/timings.json"))
    assert (timing.job, timing.units, timing.unit) == ("evaluate SpiralMaze random default seed 0", 3, "episodes")
    (job,) = table()._plan(table().selection)[0]
    assert (job.finding.done, job.wanted) == (3, True)
    assert cli.main(job.command) == 0, "the command of the plan, here instead of in another process"
    assert path.read_bytes().startswith(before), "what was recorded stays as it is"
    assert [record.episode_seed for record in read_records(path)] == [0, 1, 2, 3, 4]
    table().run(quiet)
    assert "| **random** | 0.0 (0.0 to 43.4)<br>paper – |" in Path("docs/results.md").read_text()


def test_records_of_another_config_are_refused_or_moved_aside() -> None:
    old = fill(RANDOM, [True] * 5, config_hash="0123456789ab")
    (job,) = table()._plan(table().selection)[0]
    with pytest.raises(RecordError, match=r"`config_hash` is 0123456789ab.*Add --fresh"):
        table()._prepare(job, 1)
    assert table(fresh=True)._prepare(job, 1) == (*job.command, "--fresh")
    old.unlink()
    assert table()._prepare(job, 1) == job.command
    fill(RANDOM, [True] * 5)
    assert table()._prepare(job, 1) is None, "done in the meantime"


def test_the_time_of_a_job_with_one_thread_is_the_work_that_it_did(tmp_path):
    busy = "import time\nwhile time.process_time() < 0.3: pass\ntime.sleep(0.4)"
    alone, pair = Child((), tmp_path / "one.log", 1, busy), Child((), tmp_path / "two.log", 2, busy)
    for child in (pair, alone):
        while child.poll() is None:
            time.sleep(0.01)
        child.end()
    assert 0.3 <= alone.work_seconds < 0.65
    assert pair.work_seconds >= 0.7
