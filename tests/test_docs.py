"""The documentation: every symbol exists, every item of the paper has a place, commands and code run."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from velap import cli

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
EQUATIONS = DOCS / "equations.md"
SYMBOL = re.compile(r"`(velap(?:\.\w+)+)`")
ITEMS = (
    *(f"Eq. {n}" for n in range(1, 10)),
    *(f"Table {n}" for n in range(1, 12)),
    *(f"Figure {n}" for n in range(1, 9)),
    *(f"B.{n}" for n in range(1, 8)),
    *(f"D.{n}" for n in range(1, 8)),
    *(f"E.{n}" for n in range(1, 5)),
)
LINES_OF = {"Alg. 1": 19, "Alg. 2": 14}
"""Printed lines of the paper's algorithms."""


def resolve(symbol: str) -> object:
    """What a dotted name means: a module, or an attribute or dataclass field of one."""
    parts = symbol.split(".")
    for split in range(len(parts), 0, -1):
        try:
            found: object = import_module(".".join(parts[:split]))
        except ModuleNotFoundError:
            continue
        for name in parts[split:]:
            if not hasattr(found, name) and dataclasses.is_dataclass(found):
                assert name in {field.name for field in dataclasses.fields(found)}, f"{symbol}: no field {name}"
                return found
            found = getattr(found, name)
        return found
    raise ModuleNotFoundError(symbol)


def first_cells(path: Path) -> list[str]:
    """First cell of every table row of a page."""
    return [line.split("|")[1].strip() for line in path.read_text().splitlines() if line.startswith("| ")]


TODAY = [page for page in sorted(DOCS.rglob("*.md")) if page.parent.name not in ("adr", "experiments")]
"""Pages about today's code; decisions and experiments may name what is gone."""


@pytest.mark.parametrize("page", TODAY, ids=lambda page: str(page.relative_to(DOCS)))
def test_symbols_exist(page: Path) -> None:
    missing = []
    for symbol in dict.fromkeys(SYMBOL.findall(page.read_text())):
        try:
            resolve(symbol)
        except (AttributeError, ModuleNotFoundError, AssertionError):
            missing.append(symbol)
    assert not missing, f"{page.name} names what is not there"


def test_resolve_refuses_what_is_not_there() -> None:
    with pytest.raises(AttributeError):
        resolve("velap.losses.no_such_loss")


@pytest.mark.parametrize("item", ITEMS)
def test_every_item_of_the_paper_has_a_row(item: str) -> None:
    pattern = re.compile(rf"{re.escape(item)}(?!\d)")
    assert any(pattern.match(cell) for cell in first_cells(EQUATIONS)), f"{item} has no row in docs/equations.md"


@pytest.mark.parametrize("algorithm", LINES_OF)
def test_every_line_of_the_algorithms_has_a_row(algorithm: str) -> None:
    lines: list[int] = []
    for cell in first_cells(EQUATIONS):
        if cell.startswith(algorithm):
            numbers = cell.removeprefix(algorithm).split(":")[0]
            for first, last in re.findall(r"(\d+)(?:-(\d+))?", numbers):
                lines += range(int(first), int(last or first) + 1)
    assert sorted(lines) == list(range(1, LINES_OF[algorithm] + 1))


FENCE = re.compile(r"(?:<!-- (?P<mark>[^>]*) -->\n)?```(?P<language>\w+)(?: title=\"(?P<title>[^\"]+)\")?\n"
                   r"(?P<text>.*?)```", re.DOTALL)
SKIPPED = "skipped by the tests: "


def blocks(page: Path, language: str) -> list[re.Match[str]]:
    """Fenced blocks of a page in one language, with their title and the comment before them."""
    return [block for block in FENCE.finditer(page.read_text()) if block["language"] == language]


def run_here(command: list[str], folder: Path) -> str:
    """Output of a command in a folder that has the released checkpoints; fails with it unless the exit code is 0."""
    for name in ("checkpoints", "results"):
        if not (folder / name).exists():
            (folder / name).symlink_to(ROOT / name)
    path = os.pathsep.join([str(folder), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    there = {**os.environ, "PYTHONPATH": path, "MINARI_DATASETS_PATH": str(folder / "datasets"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=folder, env=there, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def run_python(page: Path, folder: Path) -> str:
    """Output of the page's Python blocks, run one after the other; titled ones are modules beside the script."""
    script = []
    for block in blocks(page, "python"):
        if block["title"]:
            (folder / block["title"]).write_text(block["text"])
        else:
            script.append(block["text"])
    (folder / "page.py").write_text("\n".join(script))
    return run_here([sys.executable, "-W", "ignore", "page.py"], folder)


@pytest.mark.timeout(400)
def test_the_tutorial_ends_with_a_policy(tmp_path: Path) -> None:
    printed = run_python(DOCS / "tutorial.md", tmp_path)
    solved = {method: int(count) for method, count in re.findall(r"^(\w+) (\d+) of 10 in", printed, re.MULTILINE)}
    assert solved["velap"] >= 7, printed
    assert solved["random"] <= 2, printed
    assert re.search(r"^(not )?solved after \d+ steps", printed, re.MULTILINE), printed


@pytest.mark.parametrize("page", ["own-environment", "extend"])
def test_the_python_of_how_tos_runs(page: str, tmp_path: Path) -> None:
    run_python(DOCS / f"how-to/{page}.md", tmp_path)


def test_readme_skips_with_a_reason_only() -> None:
    for block in blocks(ROOT / "README.md", "bash"):
        mark = block["mark"] or ""
        assert not mark or mark.removeprefix(SKIPPED).strip(" -") not in ("", mark), f"say why this is skipped: {mark!r}"


@pytest.mark.timeout(300)
def test_readme_commands_run_as_written(tmp_path: Path) -> None:
    commands = [line for block in blocks(ROOT / "README.md", "bash") if not block["mark"]
                for line in block["text"].splitlines()]
    assert len(commands) >= 4
    for command in commands:
        velap, *arguments = shlex.split(command)
        assert velap == "velap", f"{command!r}: mark its block with `<!-- {SKIPPED}REASON -->`"
        run_here([sys.executable, "-c", "import sys; from velap.cli import main; sys.exit(main())", *arguments], tmp_path)


COMMANDS = sorted({line for page in [ROOT / "README.md", *TODAY] for block in blocks(page, "bash")
                   for line in block["text"].splitlines() if line.startswith("velap ")})


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_have_the_options_that_the_pages_use(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(command)
    with contextlib.suppress(SystemExit):
        cli.main([words[1], "--help"])
    help_text = capsys.readouterr().out
    assert "usage: " in help_text, f"`velap {words[1]}` is no command"
    for word in words[2:]:
        if word.startswith("--"):
            assert re.search(rf"{word}(?![\w-])", help_text), f"`velap {words[1]}` has no option {word}"


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    run = subprocess.run([sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)], cwd=ROOT,
                         capture_output=True, text=True, check=False, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "equations/index.html").exists()


ADRS = sorted((DOCS / "adr").glob("0*.md"))


@pytest.mark.parametrize("page", ADRS, ids=lambda page: page.stem)
def test_a_decision_has_its_parts_and_a_row_in_the_index(page: Path) -> None:
    text = page.read_text()
    number, title = re.match(r"# (\d+)\. (.+)\n", text).groups()  # type: ignore[union-attr]  # no match is a failure
    status = re.search(r"^- Status: (.+)$", text, re.MULTILINE)
    assert status is not None
    assert re.match(r"(Accepted|Rejected|Superseded by \[)", status[1]), f"unknown status {status[1]!r}"
    assert re.search(r"^- Recorded: \d{4}-\d\d-\d\d, `[0-9a-f]{7}`$", text, re.MULTILINE)
    for part in ("Context", "Decision", "Evidence"):
        assert re.search(rf"^## {part}\n\n\S", text, re.MULTILINE), f"no {part.lower()}"
    row = f"| {number} | [{title}]({page.name}) | {status[1]} |"
    assert row in (DOCS / "adr/index.md").read_text()
    assert int(number) == int(page.stem[:4])


def test_experiments_are_in_their_index() -> None:
    index = (DOCS / "experiments/index.md").read_text()
    for page in (DOCS / "experiments").glob("2*.md"):
        assert f"({page.name})" in index, f"{page.name} is not in docs/experiments/index.md"
