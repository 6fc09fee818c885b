"""`velap demo`: test episodes solved live with the released checkpoint, a video of them and a picture of the first plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from velap.evaluation.console import EpisodeBar
from velap.evaluation.evaluate import Evaluation, load_player, to_record
from velap.evaluation.records import Record
from velap.evaluation.rollout import Moment
from velap.evaluation.summary import Summary, summarise, summary_text
from velap.methods.tree_agent import TreeAgent
from velap.models.checkpoint import released_checkpoint
from velap.report.figures import Planned, plan_figure, planned
from velap.report.video import VideoRecorder, latent_map_of, picture
from velap.search.types import Plan

PICTURE = 512
"""Side of the frame in the picture [px]."""


def run_demo(console: Console, task: str, *, checkpoint: Path | None = None, episodes: int = 10, out: Path,
             device: str = "auto") -> Summary:
    """Play test episodes 0 ... `episodes` - 1 at once; writes `episodes.mp4` and `plan.png` into `out`."""
    path = checkpoint or released_checkpoint(task)
    player = load_player(Evaluation(task, checkpoint=path, device=device))
    console.print(f"{task} with {path}: {episodes} test episodes at once", markup=False)
    with console.status("looking at the world through the encoder"):
        latent_map = latent_map_of(player)
    video, records, first = out / "episodes.mp4", list[Record](), list[tuple[Planned, NDArray[np.uint8]]]()
    with EpisodeBar(console, "demo", episodes) as view, VideoRecorder(video, episodes, latent_map) as recorder:

        def observe(moment: Moment) -> None:
            if not first and (plan := plan_of(moment, 0)) is not None:
                first.append((plan, picture(moment, PICTURE)))
            recorder(moment)
            view.step(moment.row)

        for episode in player.episodes(range(episodes), episodes, observe):
            records.append(to_record(player.key, episode, episodes, player.device))
            view(records[-1])
    summary = summarise(records)
    console.print(summary_text(summary), markup=False, soft_wrap=True)
    console.print(f"video {video}", markup=False)
    if latent_map is not None and first:
        plan_figure(out / "plan.png", *first[0], latent_map, "VELAP's first plan of episode 0")
        console.print(f"picture {out / 'plan.png'}", markup=False)
    return summary


def plan_of(moment: Moment, seed: int) -> Planned | None:
    """The plan that the agent has just made in the episode of `seed`; None where it made none."""
    agent = moment.agent
    if moment.seed != seed or not isinstance(agent, TreeAgent) or not isinstance(agent.last_plan, Plan):
        return None
    rows = np.flatnonzero(agent.last_plan_rows == moment.row)
    return planned(agent.last_plan, int(rows[0])) if len(rows) else None
