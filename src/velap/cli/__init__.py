"""The command line. Heavy imports wait inside the commands, so that help and wrong options answer at once."""

from __future__ import annotations

import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from tyro.conf import Positional, UseAppendAction, arg

from velap.cli.serve import export, serve
from velap.cli.settings import parse_settings
from velap.errors import ConfigError, VelapError
from velap.storage import OWN_RECORDS, SHIPPED_RECORDS

OUT = Console(highlight=False)
ERR = Console(stderr=True, highlight=False)

Task = Annotated[Positional[str], arg(help="Task name, see `velap info`.")]
Preset = Annotated[Literal["default", "paper"], arg(help="`paper` is Tables 2-10 alone, `default` what measured best.")]
Method = Annotated[str, arg(help="Registered method: `velap`, a baseline of Table 1 (`bc`, `bc-success`, `td3bc`, `iql`, "
                                 "`mppi`, `mbop`, `iris`, `iris-multistep`), `iql-sparse`, `random`, or one of yours.")]
Device = Annotated[Literal["auto", "cpu", "cuda"], arg(help="`auto` takes CUDA where there is one.")]
Settings = Annotated[tuple[tuple[str, ...], ...], UseAppendAction,
                     arg(name="set", help="Config fields to replace, such as `planner.n_iter=500`.")]
"""One tuple for each `--set` of the command line."""
Records = Annotated[Path, arg(help="Root of the episode records.")]


def collect(task: Task, seed: int = 0, workers: int | None = None, dataset_id: str | None = None,
            overwrite: bool = False) -> None:
    """Collect the dataset of a task (Table 10) as a Minari dataset.

    Args:
        seed: Decides every array, whatever the number of workers.
        workers: Processes; one a core unless said.
        dataset_id: Minari id to write; the task's own unless said.
        overwrite: Replace a dataset of that id.
    """
    from velap.data.collection import collect as run
    from velap.evaluation.console import View
    from velap.tasks import get_task

    recipe = get_task(task).recipe
    with View(OUT, f"collecting {task}", recipe.contexts * recipe.trajectories) as view:
        result = run(task, seed, workers, dataset_id, overwrite, progress=lambda done, _: view.show(done),
                     command=_command())
    for note in result.notes:
        ERR.print(f"note: {note}", markup=False)
    OUT.print(result.card, markup=False, soft_wrap=True)
    OUT.print(f"dataset {result.dataset_id} in {result.path}, {result.seconds:.0f} s\n"
              f"content hash {result.content_hash}", markup=False, soft_wrap=True)


def train(task: Positional[str | None] = None, dataset: str | None = None, image_key: str | None = None,
          preset: Preset = "default", seed: int = 0, out: Path | None = None, device: Device = "auto", resume: bool = False,
          settings: Settings = (), method: Method = "velap", base: Path | None = None) -> None:
    """Train on a task's dataset or on any Minari dataset with images and a sparse reward.

    All methods share the joint training; it is done first where its checkpoint is missing. BC, IQL and IRIS then learn on
    its latents (`--set head.steps=5000` changes how) and go on by themselves after an interruption.

    Args:
        task: Task name; leave it out with --dataset.
        dataset: Minari dataset id.
        image_key: Key of the image in dict observations.
        seed: Decides weights and batches.
        out: Run directory; runs/TASK/PRESET/seedSEED unless said.
        resume: Go on with the unfinished run in the run directory.
        base: Finished checkpoint of the same task, preset, seed and data: only the policies that VELAP alone acts by are
            learnt anew.
    """
    if (task is None) == (dataset is None):
        raise ConfigError(f"got the task {task!r} and the dataset {dataset!r}; expected one of them: `velap train TASK` or "
                          "`velap train --dataset ID`.")
    if task is not None:
        from velap.tasks import get_task

        get_task(task)
    checkpoint = _train(str(task or dataset), preset, seed, out, image_key, device, resume, settings, method, base)
    OUT.print(f"checkpoint {checkpoint}", markup=False)


def _train(source: str, preset: str, seed: int, out: Path | None, image_key: str | None, device: str, resume: bool,
           settings: Sequence[Sequence[str]], method: str = "velap", base: Path | None = None) -> Path:
    """Train with a progress bar; returns the joint checkpoint."""
    from velap import api
    from velap.evaluation.console import TrainView
    from velap.methods.base import get_method
    from velap.training.loop import MODEL

    kind = get_method(method)
    learns = kind.learns
    changes = parse_settings(settings, {"head": kind.learner_config(preset)} if learns else {})
    directory = out or api.run_dir(api.task_of(source), preset, seed)
    if learns and not (directory / MODEL).exists():
        ERR.print(f"note: no joint checkpoint in {directory}; it is trained first", markup=False, soft_wrap=True)
    view = TrainView(OUT)
    try:
        checkpoint = api.train(source, preset, seed, out, method=method, image_key=image_key, device=device, resume=resume,
                               changes=changes, base=base, command=_command(), on_progress=view)
    finally:
        view.close()
    if learns:
        _show_head(checkpoint, method)
    return checkpoint


def _show_head(checkpoint: Path, method: str) -> None:
    """Where the head is, how long it took, and its held-out losses."""
    from velap.methods.heads import head_path
    from velap.methods.learning import read_result

    result = read_result(head_path(checkpoint, method))
    losses = ", ".join(f"{name} {value:.3g}" for name, value in result.diagnostics.items())
    OUT.print(f"head {result.path}: {result.steps} updates in {result.seconds:.0f} s; {losses}", markup=False,
              soft_wrap=True)


def evaluate(task: Task, checkpoint: Path | None = None, method: Method = "velap", episodes: int = 100, first_seed: int = 0,
             env: str | None = None, env_kwargs: tuple[str, ...] = (), image_key: str | None = None,
             max_steps: int | None = None, success_reward: float | None = None, preset: Preset = "default",
             records: Records = OWN_RECORDS, fresh: bool = False, batch: int = 10, video: bool = False,
             device: Device = "auto", settings: Settings = (), head: Path | None = None) -> None:
    """Run seeded test episodes and record each; repeat the command to go on where it stopped.

    Args:
        checkpoint: `model.safetensors` of a run; `random` needs none.
        episodes: Number of episodes.
        first_seed: Seed of the first one; test seeds are 0 to 99.
        env: Any Gymnasium id, `module:Env-v0` included, instead of the task's own; TASK is then any label.
        env_kwargs: Arguments of the environment, such as `obs_type=pixels`.
        image_key: Key of the image in dict observations.
        max_steps: Time limit where the environment has none, or a shorter one.
        success_reward: Least reward that means success where the environment's info does not tell; any positive one unless
            said.
        fresh: Move an existing record file aside first.
        batch: Environments at once.
        video: Film the first episode as well.
        head: What the method learnt; METHOD.safetensors beside the checkpoint unless said.
    """
    from velap.cli.settings import parse_pairs
    from velap.evaluation.evaluate import Evaluation
    from velap.methods.base import get_method

    changes = parse_settings(settings, {method: get_method(method).settings})
    what = Evaluation(task, method=method, checkpoint=checkpoint, preset=preset, env=env, env_kwargs=parse_pairs(env_kwargs),
                      image_key=image_key, max_steps=max_steps, success_reward=success_reward, device=device,
                      changes=changes, head=head)
    _evaluate(what, range(first_seed, first_seed + episodes), records, fresh, batch, video)


def _evaluate(what: Any, seeds: range, records: Path, fresh: bool, batch: int, video: bool) -> None:
    """Evaluate with a progress bar and print the summary."""
    from velap.evaluation.console import EpisodeView
    from velap.evaluation.evaluate import evaluate as run
    from velap.evaluation.evaluate import load_player
    from velap.evaluation.summary import summarise, summary_table

    player = load_player(what)
    with EpisodeView(OUT, f"{what.method} on {what.task}", len(seeds)) as view:
        results = run(what, seeds, records, batch=batch, fresh=fresh, on_record=view, player=player)
    OUT.print(summary_table(summarise(results)))
    OUT.print(f"records {player.key.path(records)}", markup=False)
    if video:
        from velap.report.video import film

        path = Path("runs/videos") / player.key.path(Path()).with_suffix("") / f"episode{seeds[0]}.mp4"
        film(player, [seeds[0]], path)
        OUT.print(f"video {path}", markup=False)


def run(task: Task, preset: Preset = "default", seed: int = 0, episodes: int = 100, out: Path | None = None,
        records: Records = OWN_RECORDS, fresh: bool = False, workers: int | None = None, device: Device = "auto",
        settings: Settings = ()) -> None:
    """Collect (if the dataset is missing), train and evaluate in one go; repeat the command to go on where it stopped.

    Args:
        seed: Decides weights and batches.
        episodes: Test episodes, seeds from 0.
        out: Run directory; runs/TASK/PRESET/seedSEED unless said.
        fresh: Move an existing record file aside first.
        workers: Processes that collect; one a core unless said.
    """
    from velap.data import minari_io
    from velap.evaluation.evaluate import Evaluation
    from velap.tasks import get_task

    if not minari_io.exists(get_task(task).dataset_id):
        collect(task, workers=workers)
    checkpoint = _train(task, preset, seed, out, None, device, True, settings)
    OUT.print(f"checkpoint {checkpoint}", markup=False)
    _evaluate(Evaluation(task, checkpoint=checkpoint, device=device), range(episodes), records, fresh, 10, False)


def table(number: Annotated[Positional[Literal["1"] | None], arg(help="`1`: make Table 1 of the paper.")] = None,
          records: Path | None = None, write: Path | None = None, only: tuple[str, ...] = (), jobs: int = 2,
          dry_run: bool = False, no_run: bool = False, fresh: bool = False, episodes: int = 100, batch: int = 1) -> None:
    """Print the statistics of all records; with `1`, run whatever Table 1 still lacks and write it.

    `velap table 1` collects, trains and evaluates every cell that has no records of today's config, and can be interrupted
    at any time: the same command goes on from there.

    Args:
        records: Root of the episode records; runs/records unless said, with `1` those of the published tables in
            results/records.
        write: Document to update between its table marks, such as docs/records.md; with `1` docs/results.md, or another
            one to write.
        only: Cells to run, such as `task=SpiralMaze method=bc,iql`. Axes are task, method, preset and seed; unless said all
            tasks, all methods, preset=default and seed=0.
        jobs: Jobs at once, on one machine; each gets its share of the cores.
        dry_run: Only say what is there, what is missing and how long it should take.
        no_run: Only write the table from the records that are there.
        fresh: Move runs and records of another config aside and make them anew; their jobs fail otherwise.
        episodes: Test episodes of a cell, seeds from 0.
        batch: Episodes at once; one by one, an interruption loses one episode at most.
    """
    if number is None:
        if only or dry_run or no_run or fresh or (jobs, episodes, batch) != (2, 100, 1):
            raise ConfigError("got options of `velap table 1` without the number; expected `velap table 1 ...`, or only "
                              "--records and --write.")
        _table_of_records(records or OWN_RECORDS, write)
        return
    records = records or SHIPPED_RECORDS
    table1 = _study("table_command")
    places = table1.Places(records.parent) if write is None else table1.Places(records.parent, write)
    options = _study("jobs").Options(records, episodes, batch)
    one = table1.TableOne(_study("matrix").parse_only(only), options, places, jobs, fresh)
    if dry_run:
        one.dry_run(OUT)
    elif no_run:
        one.write(OUT)
    else:
        one.run(OUT)


def _table_of_records(records: Path, write: Path | None) -> None:
    """Every record file on a line, printed or written between the table marks of a document."""
    from velap.evaluation.summary import markdown_table, rich_table, summarise_all, write_into

    summaries = summarise_all(records)
    if write is None:
        OUT.print(rich_table(summaries))
    else:
        write_into(write, markdown_table(summaries))
        OUT.print(f"table written into {write}", markup=False)


def demo(task: Positional[str] = "SpiralMaze", checkpoint: Path | None = None, episodes: int = 10,
         out: Path = Path("runs/demo"), device: Device = "auto") -> None:
    """Solve test episodes live with the released checkpoint; writes a video and a picture of plan and latent space.

    Args:
        task: Task name.
        checkpoint: Another checkpoint than the released one.
        episodes: Test episodes, seeds from 0.
        out: Where the video and the picture go.
    """
    from velap.report.demo import run_demo

    run_demo(OUT, task, checkpoint, episodes, out, device)


def bench(json: Path | None = None, only: tuple[str, ...] = (), device: Device = "auto") -> None:
    """Measure the speed ratios side by side and print them.

    Args:
        json: Write them to this file as well, such as results/bench/cpu.json.
        only: Names of the benchmarks to measure, such as plan_latency_1; all unless said.
    """
    _study("speed").run_benchmarks(OUT, json, device, only)


def diagnose(task: Positional[str | None] = None, checkpoint: Path | None = None, dataset: str | None = None,
             out: Path | None = None, episodes: int = 10, first_seed: int = 1000, env: str | None = None,
             image_key: str | None = None, max_steps: int | None = None, device: Device = "auto",
             settings: Settings = ()) -> None:
    """Look into a trained model and its plans, and at where its episodes fail; writes pictures and a page of text.

    Args:
        task: Task name; leave it out with --dataset.
        checkpoint: `model.safetensors` of a run; the task's released one unless said.
        dataset: Minari dataset that the model is compared with; the task's own unless said.
        out: Folder of the report; runs/diagnosis/TASK unless said.
        episodes: Episodes that are run and judged.
        first_seed: Seed of the first one; seeds 0 to 99 are the test episodes and refused.
        env: Any Gymnasium id instead of the task's own.
        image_key: Key of the image in dict observations.
        max_steps: Time limit where the environment has none.
    """
    from velap.report.diagnose.command import Request, run_diagnose

    run_diagnose(OUT, Request(task, checkpoint, dataset, out, episodes, first_seed, device, parse_settings(settings), env,
                              image_key, max_steps, _command()))


def study(subject: Annotated[Positional[Literal["faults", "experts", "exact-latents"]],
                             arg(help="`faults`: kills, damage, full disks. `experts`: can the tasks be solved. "
                                      "`exact-latents`: what all but the encoder can do.")],
          quick: bool = False, seed: int = 0, write: Path | None = None, json: Path | None = None,
          task: str = "DrawerButton", settings: Settings = ()) -> None:
    """Try what may go wrong, on a task shrunk to seconds; try whether each task can be solved, and not by chance; or train
    and evaluate on true states instead of latents of frames.

    Args:
        quick: Two kills a command instead of twenty; ten episodes instead of a hundred (fifty on exact latents).
        seed: Decides the moments of the kills; seed of the experts' first episode; training seed of exact latents.
        task: Manipulation task of exact latents.
        write: Document to write, such as docs/faults.md or docs/experts.md.
        json: Figures of the experts go to this file as well, such as results/experts.json.
    """
    if subject == "faults":
        _study("study").study_faults(OUT, quick, seed, write)
    elif subject == "exact-latents":
        _study("exact").study_exact_latents(OUT, task, parse_settings(settings), seed, quick, json)
    else:
        from velap.evaluation.experts import study_experts

        study_experts(OUT, quick, seed, write, json)


def figure(name: Annotated[Positional[Literal["tasks", "sawyer-drawing"]], arg(help="What to draw.")],
           write: Path | None = None) -> None:
    """Draw a picture of the documentation anew.

    `tasks`: test start and goal state of every task, as an agent sees them. `sawyer-drawing`: our drawing of the arm beside
    Meta-World's geometry.

    Args:
        write: Where it goes; docs/NAME.png (with _ for -) unless said.
    """
    path = write or Path("docs") / f"{name.replace('-', '_')}.png"
    if name == "tasks":
        _study("gallery").show_tasks(OUT, path)
    else:
        _study("drawing").show_drawing(OUT, path)


def _study(name: str) -> ModuleType:
    """Module `studies.name` of the checkout that this package runs from; the installed package does without the studies."""
    checkout = Path(__file__).resolve().parents[3]
    if not (checkout / "studies" / f"{name}.py").is_file():
        raise ConfigError(f"found no folder `studies` in {checkout}; expected a checkout of velap. "
                          "Clone the repository and install it with `pip install -e .`.")
    if str(checkout) not in sys.path:
        sys.path.append(str(checkout))
    return import_module(f"studies.{name}")


def info() -> None:
    """Versions, tasks and what this machine offers."""
    from velap.cli.info import describe

    OUT.print(describe(), markup=False, soft_wrap=True)


COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": demo, "collect": collect, "train": train, "evaluate": evaluate, "run": run, "table": table, "bench": bench,
    "diagnose": diagnose, "study": study, "figure": figure, "info": info, "serve": serve, "export": export,
}


def _command() -> str:
    """The command as it was typed, for provenance."""
    return shlex.join(["velap", *sys.argv[1:]])


def _show_warning(message: Warning | str, *_: Any) -> None:
    ERR.print(f"note: {message}", markup=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 after an error that says what to do, 130 after Ctrl-C."""
    warnings.filterwarnings("default", category=UserWarning, module=r"velap\..*")
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="velap", description="Value-guided expansive latent planning (VELAP, CoRL 2023).", args=arguments,
            config=(tyro.conf.PositionalMetavarFromFieldName, tyro.conf.FlagCreatePairsOff))
    except VelapError as error:
        ERR.print(f"velap: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    except KeyboardInterrupt:
        ERR.print("stopped; the same command goes on from here (`velap train` with --resume)", markup=False, soft_wrap=True)
        return 130
    return 0
