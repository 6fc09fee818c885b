"""`velap table`, `velap bench`, `velap study` and `velap figure`; all but the table of all records need a checkout."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from velap.cli.options import OUT, Device, ImageKey, Settings, joined, say
from velap.cli.settings import parse_settings
from velap.errors import ConfigError
from velap.storage import OWN_RECORDS, SHIPPED_RECORDS


def table(number: Annotated[Positional[Literal["1", "11"] | None],
                            arg(help="`1`, `11`: make that table of the paper; 11 has the robot tasks.")] = None,
          records: Path | None = None, write: Path | None = None, only: tuple[str, ...] = (), jobs: int = 2,
          dry_run: bool = False, no_run: bool = False, fresh: bool = False, episodes: int = 100, batch: int = 1) -> None:
    """Print the statistics of all records; with a number, run whatever that table of the paper still lacks and write it.

    `velap table 1` and `velap table 11` collect, train and evaluate every cell that has no records of today's config.
    Interrupt them at any time: the same command goes on from there.

    Args:
        records: Root of the episode records. Default: runs/records; with a number results/records, those of the published
            tables.
        write: Document to update between its table marks, such as docs/records.md; with a number docs/results.md or
            docs/table11.md, or another one to write.
        only: Cells to run, such as `task=SpiralMaze method=bc,iql`. Axes are task, method, preset and seed. Default: all
            tasks of the table, all methods, preset=default, seed=0.
        jobs: Jobs at once, on one machine; each gets its share of the cores.
        dry_run: Only say what is there, what is missing and which jobs would run.
        no_run: Only write the table from the records that are there.
        fresh: Move runs and records of another config aside and make them anew; their cells fail otherwise.
        episodes: Test episodes of a cell, seeds from 0.
        batch: Episodes at once; one by one, an interruption loses one episode at most.
    """
    if number is None:
        if only or dry_run or no_run or fresh or (jobs, episodes, batch) != (2, 100, 1):
            raise ConfigError("got options of `velap table 1` without the number; expected `velap table 1 ...`, `velap "
                              "table 11 ...`, or only --records and --write.")
        from velap.evaluation.summary import markdown_table, summarise_all, write_into

        text = markdown_table(summarise_all(records or OWN_RECORDS))
        if write is None:
            say(text)
        else:
            write_into(write, text)
            say(f"table written into {write}")
        return
    page = write or Path("docs/results.md" if number == "1" else "docs/table11.md")
    one = _study("table1.workflow").Table(
        number=number, cells=_study("table1.cells").parse_only(only, number), only=" ".join(only),
        records=records or SHIPPED_RECORDS, episodes=episodes, batch=batch, jobs=jobs, fresh=fresh, page=page)
    do = one.dry_run if dry_run else one.write if no_run else one.run
    do(OUT)


def bench(json: Path | None = None, only: tuple[str, ...] = (), device: Device = "auto") -> None:
    """Measure the speed ratios side by side and print them.

    Args:
        json: Write them to this file as well, such as results/bench/cpu.json.
        only: Names of the benchmarks to measure, such as plan_latency_1. Default: all.
    """
    _study("speed.command").run_benchmarks(OUT, json, device, only)


def study(subject: Annotated[Positional[Literal["faults", "experts", "exact-latents", "server", "paper"]],
                             arg(help="`faults`: kills, damage, full disks. `experts`: can each task be solved, and not by "
                                      "chance. `exact-latents`: what everything but the encoder can do. "
                                      "`server`: wrong messages by the thousand. `paper`: all its tables and figures.")],
          quick: bool = False, seed: int = 0, write: Path | None = None, json: Path | None = None,
          task: str = "DrawerButton", settings: Settings = (), dry_run: bool = False, fresh: bool = False) -> None:
    """Try what may go wrong, whether the tasks can be solved, or true states instead of latents of frames; or make every
    table and figure of the paper, which goes on where it was interrupted.

    Args:
        quick: Two kills a command instead of twenty; ten episodes instead of a hundred (fifty on exact latents); 3,000
            messages instead of 100,000.
        seed: Decides the moments of the kills; seed of the experts' first episode; training seed of exact latents.
        task: Task of exact latents.
        write: Document to write, such as docs/faults.md or docs/experts.md.
        json: Figures of the experts or the server go to this file as well, such as results/experts.json.
        dry_run: Paper: only say what is there, and about how long the rest takes.
        fresh: Paper: move records of another config aside and make them anew.
    """
    if subject == "paper":
        _study("paper").make_paper(OUT, dry_run, fresh)
    elif subject == "faults":
        _study("faults.study").study_faults(OUT, quick, seed, write)
    elif subject == "exact-latents":
        _study("exact_latents").study_exact_latents(OUT, task, parse_settings(settings), seed, quick, json)
    elif subject == "server":
        _study("serving").study_server(OUT, quick, json)
    else:
        _study("experts").study_experts(OUT, quick, seed, write, json)


def figure(name: Annotated[Positional[Literal["3", "5", "6", "7", "8", "tasks", "tasks-widowx"]],
                           arg(help="Number of the paper's figure, or a picture of the documentation.")],
           task: Annotated[Positional[str | None], arg(help="Of figures 3, 5 and 6. Default: both mazes, in 5 and 6 "
                                                            "WindowClose too.")] = None,
           write: Path | None = None, checkpoint: Path | None = None, dataset: str | None = None,
           image_key: ImageKey = (), device: Device = "auto", episodes: int = 50, no_run: bool = False,
           fresh: bool = False, seeds: tuple[int, ...] = (0, 1), updates: tuple[int, int] | None = None,
           dry_run: bool = False) -> None:
    """Make a figure of the paper, or draw a picture of the documentation anew.

    `3`: the latent space, its values and planned paths. `5`: encoders, and what comes of them. `6`: losses of h, and what
    comes of them. `7` and `8`: success against planning time in SpiralMaze and in ObstacleMaze. Interrupt 5 to 8 at any
    time, the same command goes on from there. `tasks`: test start and success of every task, as an agent sees them.
    `tasks-widowx`: an expert's episode of each task of the WidowX arm.

    Args:
        write: The PNG; figures of the paper get a PDF beside it. Default: docs/figures/figNUMBER.png or docs/NAME.png (with
            _ for -); runs/figures for figure 3 of your own checkpoint or dataset.
        checkpoint: Figures 3, 7, 8: `model.safetensors` of a run. Default: the released one.
        dataset: Figure 3: states of this dataset instead of those of an environment seen from above; panels a and c stay
            empty.
        device: Figures 3, 5, 6: where the networks run.
        episodes: Figures 5 to 8: episodes a bar or point, seeds from 1000.
        no_run: Only draw what was made before.
        fresh: Figures 5 to 8: move records of another checkpoint or config aside and make them anew.
        seeds: Figures 5 and 6: training seeds.
        updates: Figures 5 and 6: updates on frames, and on frozen latents. Default: those of the default preset.
        dry_run: Figures 5 and 6: only say which cells are there.
    """
    if name == "3":
        from velap.report.latent_figure import show

        show(OUT, task, checkpoint=checkpoint, dataset=dataset, image_key=joined(image_key), device=device, no_run=no_run,
             write=write)
        return
    if name in ("5", "6"):
        ablations, kind = _study("ablations"), _study("representation" if name == "5" else "dynamics_loss")
        plan = ablations.Plan(study=kind.STUDY, tasks=ablations.TASKS if task is None else (task,), seeds=seeds,
                              updates=updates, episodes=episodes, device=device)
        ablations.show(OUT, plan, write or Path(f"docs/figures/fig{name}.png"), dry_run=dry_run, no_run=no_run, fresh=fresh)
        return
    if task is not None:
        raise ConfigError(f"`velap figure {name}` got the task {task!r}; only figures 3, 5 and 6 take one. Leave it out.")
    if name in ("7", "8"):
        _study("planning_time").show_planning_time(
            OUT, name, write or Path(f"docs/figures/fig{name}.png"), checkpoint=checkpoint, episodes=episodes, no_run=no_run,
            fresh=fresh)
        return
    path = write or Path("docs") / f"{name.replace('-', '_')}.png"
    if name == "tasks":
        _study("gallery").show_tasks(OUT, path)
    else:
        _study("gallery").show_episodes(OUT, path)


def _study(name: str) -> ModuleType:
    """Module `studies.name` of the checkout that this package runs from; the installed package does without the studies."""
    checkout = Path(__file__).resolve().parents[3]
    if not (checkout / "studies").is_dir():
        raise ConfigError(f"found no folder `studies` in {checkout}; expected a checkout of velap. "
                          "Clone the repository and install it with `pip install -e .`.")
    if str(checkout) not in sys.path:
        sys.path.append(str(checkout))
    return import_module(f"studies.{name}")
