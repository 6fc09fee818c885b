"""`velap demo`: test episodes solved live with the released checkpoint, a video of them and a picture of the first plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from velap.evaluation.console import EpisodeBar
from velap.evaluation.evaluate import Evaluation, Player, load_player, to_record
from velap.evaluation.records import Record
from velap.evaluation.rollout import Moment
from velap.evaluation.summary import Summary, summarise, summary_text
from velap.methods.tree_agent import TreeAgent
from velap.models.checkpoint import released_checkpoint
from velap.report.figures import LatentMap, Planned, plan_figure, planned
from velap.report.video import VideoRecorder, latent_map_of, picture
from velap.search.types import Plan

PICTURE = 512
"""Side of the frame in the picture [px]."""


class FirstPlan:
    """An observer that keeps the first plan of episode `seed` and the frame that it was made from."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._kept: tuple[Planned, NDArray[np.uint8]] | None = None

    def __call__(self, moment: Moment) -> None:
        """Keep the plan once, as soon as it is there."""
        agent = moment.agent
        wanted = self._kept is None and moment.seed == self._seed
        if wanted and isinstance(agent, TreeAgent) and isinstance(agent.last_plan, Plan):
            rows = np.flatnonzero(agent.last_plan_rows == moment.row)
            if len(rows):
                self._kept = planned(agent.last_plan, int(rows[0])), picture(moment, PICTURE)

    def draw(self, latent_map: LatentMap, path: Path) -> bool:
        """Draw it into `path`; False where the episode had no plan."""
        if self._kept is None:
            return False
        plan_figure(path, *self._kept, latent_map, f"VELAP's first plan of episode {self._seed}")
        return True


def run_demo(console: Console, task: str, *, checkpoint: Path | None = None, episodes: int = 10, out: Path,
             device: str = "auto") -> Summary:
    """Play test episodes 0 ... `episodes` - 1 at once; writes `episodes.mp4` and `plan.png` into `out`."""
    path = checkpoint or released_checkpoint(task)
    player = load_player(Evaluation(task, checkpoint=path, device=device))
    console.print(f"{task} with {path}: {episodes} test episodes at once", markup=False)
    with console.status("looking at the world through the encoder"):
        latent_map = latent_map_of(player)
    first_plan = FirstPlan(0)
    summary = summarise(_play(console, player, episodes, out / "episodes.mp4", latent_map, first_plan))
    console.print(summary_text(summary), markup=False, soft_wrap=True)
    console.print(f"video {out / 'episodes.mp4'}", markup=False)
    if latent_map is not None and first_plan.draw(latent_map, out / "plan.png"):
        console.print(f"picture {out / 'plan.png'}", markup=False)
    return summary


def _play(console: Console, player: Player, episodes: int, video: Path, latent_map: LatentMap | None,
          first_plan: FirstPlan) -> list[Record]:
    """Run and film the episodes, showing each as it ends."""
    records: list[Record] = []
    with EpisodeBar(console, "demo", episodes) as view, VideoRecorder(video, episodes, latent_map) as recorder:

        def observe(moment: Moment) -> None:
            first_plan(moment)
            recorder(moment)
            view.step(moment.row)

        for episode in player.rollout(episodes, observe).run(range(episodes)):
            records.append(to_record(player.key, episode, episodes, player.device))
            view(records[-1])
    return records
