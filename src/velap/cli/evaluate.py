"""`velap evaluate`, `velap demo` and `velap diagnose`: what a checkpoint can do."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from velap.cli.options import OUT, Device, ImageKey, Method, Preset, Records, Settings, Task, command, joined, say
from velap.cli.settings import parse_pairs, parse_settings
from velap.storage import OWN_RECORDS

if TYPE_CHECKING:
    from velap.evaluation.evaluate import Evaluation


def evaluate(task: Task, checkpoint: Path | None = None, method: Method = "velap", episodes: int = 100, first_seed: int = 0,
             env: str | None = None, env_kwargs: tuple[str, ...] = (), image_key: ImageKey = (),
             max_steps: int | None = None, success: str | None = None, preset: Preset = "default",
             records: Records = OWN_RECORDS, fresh: bool = False, batch: int = 10, video: bool = False,
             device: Device = "auto", settings: Settings = (), head: Path | None = None) -> None:
    """Run seeded test episodes and record each; repeat the command to go on where it stopped.

    Args:
        checkpoint: `model.safetensors` of a run; `random` needs none.
        episodes: Number of episodes.
        first_seed: Seed of the first one; test seeds are 0 to 99.
        env: Any Gymnasium id, `module:Env-v0` included, instead of the task's own; TASK is then any label.
        env_kwargs: Arguments of the environment, such as `obs_type=pixels`.
        max_steps: Time limit where the environment has none, or a shorter one.
        success: What counts as success, such as `reward>=0`, `info:success` or `terminated`. Default: the rule that the
            checkpoint keeps.
        fresh: Move an existing record file aside first.
        batch: Environments at once.
        video: Film the first episode as well.
        head: What the method learnt. Default: METHOD.safetensors beside the checkpoint.
    """
    from velap.evaluation.evaluate import Evaluation
    from velap.methods.base import get_method

    changes = parse_settings(settings, {method: get_method(method).settings})
    what = Evaluation(task, method=method, checkpoint=checkpoint, preset=preset, env=env, env_kwargs=parse_pairs(env_kwargs),
                      image_key=joined(image_key), max_steps=max_steps, success=success, device=device,
                      changes=changes, head=head)
    evaluate_with_progress(what, range(first_seed, first_seed + episodes), records, fresh=fresh, batch=batch, video=video)


def evaluate_with_progress(what: Evaluation, seeds: range, records: Path, *, fresh: bool = False, batch: int = 10,
                           video: bool = False) -> None:
    """Evaluate, show how far it is, and print the summary."""
    from velap.evaluation.console import EpisodeBar
    from velap.evaluation.evaluate import evaluate, load_player
    from velap.evaluation.summary import summarise, summary_text

    player = load_player(what)
    with EpisodeBar(OUT, f"{what.method} on {what.task}", len(seeds)) as view:
        results = evaluate(what, seeds, records, batch=batch, fresh=fresh, on_record=view, player=player)
    say(summary_text(summarise(results)))
    say(f"records {player.key.path(records)}")
    if video:
        from velap.report.video import film

        path = Path("runs/videos") / player.key.path(Path()).with_suffix("") / f"episode{seeds[0]}.mp4"
        film(player, [seeds[0]], path)
        say(f"video {path}")


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

    run_demo(OUT, task, checkpoint=checkpoint, episodes=episodes, out=out, device=device)


def diagnose(task: Positional[str | None] = None, checkpoint: Path | None = None, dataset: str | None = None,
             out: Path | None = None, episodes: int = 10, first_seed: int = 1000, env: str | None = None,
             env_kwargs: tuple[str, ...] = (), image_key: ImageKey = (), max_steps: int | None = None,
             success: str | None = None, device: Device = "auto", settings: Settings = ()) -> None:
    """Look into a trained model and its plans, and at where its episodes fail; writes pictures and a page of text.

    Args:
        task: Task name; leave it out with --dataset.
        checkpoint: `model.safetensors` of a run. Default: the task's released one.
        dataset: Minari dataset that the model is compared with. Default: the task's own.
        out: Folder of the report. Default: runs/diagnosis/TASK.
        episodes: Episodes that are run and judged.
        first_seed: Seed of the first one; seeds 0 to 99 are the test episodes and refused.
        env: Any Gymnasium id instead of the task's own.
        env_kwargs: Arguments of the environment, such as `obs_type=pixels`.
        max_steps: Time limit where the environment has none, or a shorter one.
        success: What counts as success, such as `reward>=0`. Default: the rule that the checkpoint keeps.
    """
    from velap.report.diagnose.command import Request, run_diagnose

    run_diagnose(OUT, Request(task=task, checkpoint=checkpoint, dataset=dataset, out=out, episodes=episodes,
                              first_seed=first_seed, device=device, changes=parse_settings(settings), env=env,
                              env_kwargs=parse_pairs(env_kwargs), image_key=joined(image_key), max_steps=max_steps,
                              success=success, command=command()))
