"""`velap view`: an episode in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from velap.cli.options import Device, Method, note, say
from velap.cli.settings import parse_pairs


def view(source: Annotated[Positional[Path], arg(help="`model.safetensors` of a run, or a record file (.jsonl).")],
         episode_seed: int | None = None, method: Method = "velap", checkpoint: Path | None = None,
         dataset: str | None = None, env: str | None = None, env_kwargs: tuple[str, ...] = (), max_steps: int | None = None,
         projection: Literal["isomap", "pca"] = "isomap", out: Path | None = None, device: Device = "auto") -> None:
    """Run an episode and write a page that shows its plans, trees and values; one HTML file without network.

    Args:
        episode_seed: Seed of the episode. Default: 1000, and of records the first failed one.
        checkpoint: Weights that the records were made by. Default: the task's released ones.
        dataset: Dataset whose frames show what waypoints look like. Default: the episode's own scene where the environment
            can be put anywhere, else the task's dataset.
        env: Any Gymnasium id instead of the task's own.
        env_kwargs: Arguments of the environment, such as `obs_type=pixels`.
        max_steps: Time limit if the environment has none, or a shorter one.
        projection: How latents become a map.
        out: The page. Default: runs/view/TASK-METHOD-seedSEED.html.
    """
    from velap.report.viewer import backdrop_of, subject_of, trace
    from velap.report.viewer_page import page
    from velap.runs import write_atomic
    from velap.storage import folder_name

    subject = subject_of(source, episode_seed=episode_seed, checkpoint=checkpoint, method=method, env=env,
                         env_kwargs=parse_pairs(env_kwargs), max_steps=max_steps, device=device)
    seen = trace(subject.player, subject.seed)
    now = seen.outcome
    for record in subject.records:
        if record.episode_seed == subject.seed and (record.success, record.steps) != (now.success, now.steps):
            note(f"the record says {_ended(record.success)} in {record.steps} steps, this run {_ended(now.success)} in "
                 f"{now.steps}: another machine, batch or version rounds differently")
    key = subject.player.key
    path = out or Path("runs/view") / f"{folder_name(key.task)}-{key.method}-seed{subject.seed}.html"
    text = page(subject, seen, backdrop_of(subject.player, subject.seed, dataset), projection)
    write_atomic(path, text.encode())
    say(f"{_ended(now.success)} in {now.steps} steps, {len(seen.plans)} plans")
    say(f"page {path}, {path.stat().st_size / 1e6:.1f} MB; open it in a browser")


def _ended(success: bool) -> str:
    return "solved" if success else "not solved"
