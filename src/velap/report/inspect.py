"""`velap inspect`: the card of a dataset and its problems, before an hour of training is spent."""

from __future__ import annotations

import dataclasses
import json
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from velap.config.training import DYNAMICS_HORIZON
from velap.data.card import dataset_card, draw_frames, episode_returns
from velap.data.frames import FrameStore
from velap.data.images import IMAGE_SIZE, Fit
from velap.data.loading import load_store
from velap.data.survey import FEWEST_STILL, JUMP, NEIGHBOURS, SAME_SCENE, Actions, Coverage, Scenes, Survey, survey
from velap.errors import DatasetError
from velap.report.figures import FilmStrip, new_figure, save_figure, strip_figure
from velap.runs import write_atomic

PAGE, FIGURES = "inspection.md", "inspection.json"
FEW_SUCCESSES = 10
"""Fewest successful episodes. ours: one in ten is held out."""
FEW_TRANSITIONS = 5_000
"""Fewest transitions. ours: a tenth of the smallest dataset of Table 10."""
MUCH_AT_BOUND = 0.6
"""Largest share of an action entry at its bounds. ours: the shipped datasets have up to 0.31."""
SMALL_RANGE = 0.2
"""Smallest share of the stated range that actions use. ours."""
JITTER = 0.1
"""Smallest autocorrelation of actions at lag 1. ours: the shipped datasets have 0.8 and more."""
MANY_EQUAL = 0.5
"""Largest share of frames equal to the one before. ours: ObstacleMaze, whose block can be stuck, has 0.10."""
LITTLE_CONTRAST = 4.0
"""Smallest standard deviation within a frame [grey levels]. ours."""
OUT_OF_REACH = 0.05
"""Smallest share of the failed episodes from whose start recorded frames lead to a success. ours."""
LONELY = 0.5
"""Largest share of frames that no other episode comes near. ours: ObstacleMaze has 0.27."""
MOST = 0.5
"""An oddity of a larger share of the episodes is a problem. ours."""
SHOWN = 24
"""Most backgrounds and lonely frames in a picture."""


@dataclass(frozen=True)
class Problem:
    """A reason why training will fail or work badly."""

    name: str
    got: str
    expected: str
    do: str
    stops: bool = False
    """Whether training refuses the dataset."""

    @classmethod
    def of_error(cls, name: str, error: DatasetError) -> Problem:
        """From an error whose text has the form `got; expected. do`."""
        got, _, rest = str(error).partition("; expected ")
        expected, _, advice = rest.partition(". ")
        return cls(name, got, expected, advice, stops=True)

    def __str__(self) -> str:
        return f"{'STOPS' if self.stops else 'warns'}  {self.name}: {self.got}; expected {self.expected}. {self.do}"


@dataclass(frozen=True)
class Inspection:
    """The findings of one dataset."""

    dataset: str
    store: FrameStore | None
    """None if it cannot be read."""
    survey: Survey | None
    notes: tuple[str, ...]
    """Changes made to the data while reading."""
    problems: tuple[Problem, ...]


def inspect(source: str, *, image_key: str | None = None, image_size: int = IMAGE_SIZE, fit: Fit | None = None,
            success: str | None = None, mapped: bool | None = None,
            state_key: str | None = None) -> Inspection:
    """Read and measure a dataset; arguments as for `load_store`. A dataset that cannot be read has that as its problem."""
    problems = []
    options: dict[str, Any] = {"image_key": image_key, "image_size": image_size, "fit": fit, "success": success,
                               "mapped": mapped, "state_key": state_key}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            store = load_store(source, **options)
        except DatasetError as error:
            caught.clear()
            try:
                store = load_store(source, **options, need_success=False)
                problems.append(Problem.of_error("no-success", error))
            except DatasetError as worse:
                return Inspection(source, None, None, (), (Problem.of_error("unreadable", worse),))
    notes = tuple(str(each.message) for each in caught)
    found = survey(store)
    return Inspection(source, store, found, notes, (*problems, *find_problems(store, found)))


def find_problems(store: FrameStore, found: Survey) -> list[Problem]:
    """All problems; those that stop a training come first."""
    problems = [*_length_problems(store), *_success_problems(store, found.coverage), *_frame_problems(found),
                *_action_problems(store, found.actions), *_coverage_problems(found.scenes, found.coverage)]
    return sorted(problems, key=lambda problem: not problem.stops)


def _length_problems(store: FrameStore) -> Iterator[Problem]:
    short = int((store.episode_length < DYNAMICS_HORIZON).sum())
    if short == store.n_episodes:
        yield Problem("short-episodes", stops=True,
                      got=f"the longest episode has {store.episode_length.max()} transitions",
                      expected=f"one of {DYNAMICS_HORIZON} or more", do="Record longer episodes, or join consecutive ones.")
        return
    if short > MOST * store.n_episodes:
        yield Problem("short-episodes",
                      got=f"{short} of {store.n_episodes} episodes have fewer than {DYNAMICS_HORIZON} transitions",
                      expected="most to be longer",
                      do="Record longer episodes. Check whether a flag at the wrong step cuts them.")
    if store.n_transitions < FEW_TRANSITIONS:
        yield Problem("few-transitions", got=f"{store.n_transitions:,} transitions",
                      expected=f"{FEW_TRANSITIONS:,} or more; the paper's tasks have 20,000 to 150,000",
                      do="Record more; play without any aim helps too.")


def _success_problems(store: FrameStore, coverage: Coverage | None) -> Iterator[Problem]:
    won = episode_returns(store) > 0
    successes = int(won.sum())
    if successes == 0:
        return  # the reader says so
    if successes < FEW_SUCCESSES:
        yield Problem("few-successes", got=f"{successes} successful episodes", expected=f"{FEW_SUCCESSES} or more",
                      do="Record more from anywhere near the goal, or check whether the rule of success misses some "
                         "(`velap label` shows the last frames).")
    at_once = int((store.episode_length[won] == 1).sum())
    if at_once > MOST * successes:
        yield Problem("success-at-once", got=f"{at_once} of {successes} successful episodes succeed at their first step",
                      expected="successes that take some steps",
                      do="Check the rule of success: it may hold at the start already. Name another with --success.")
    if coverage is not None:
        yield from _goal_problems(coverage)


def _goal_problems(coverage: Coverage) -> Iterator[Problem]:
    """Problems of the frames of success."""
    if coverage.jumps > MOST:
        yield Problem("success-frame-jumps",
                      got=f"in {coverage.jumps:.0%} of the successful episodes the last step changes the frame by more than "
                          f"{JUMP:.0%} of all steps do",
                      expected="the frame that shows the success",
                      do="Look at the red frames of frames.png: some recorders store the next episode's first frame there. "
                         "Store the final observation instead.")
    elif coverage.start_like > MOST and not coverage.start_like_others > coverage.start_like / 2:
        yield Problem("success-looks-like-start",
                      got=f"{coverage.start_like:.0%} of the frames of success look like the first frame of an episode",
                      expected="success to be visible in the frame",
                      do="Look at the red frames of frames.png. Turn the camera so that it sees what success changes, or "
                         "name another rule with --success.")
    if coverage.in_reach < OUT_OF_REACH:
        yield Problem("success-out-of-reach",
                      got=f"{coverage.in_reach:.0%} of the episodes without success start where recorded frames lead on to "
                          "a success",
                      expected=f"{OUT_OF_REACH:.0%} or more",
                      do="Record episodes that lead from where the others are to where the successful ones begin, in the "
                         "same scene and from the same camera.")


def _frame_problems(found: Survey) -> Iterator[Problem]:
    equal = f"{found.frozen_frames:.0%} of the frames equal the one before"
    if found.coverage is None or found.frozen_frames > 0.99:
        yield Problem("constant-frames", got=equal, expected="frames that show what the actions do",
                      do="Check that the recorder stores the newest picture, and of the right camera (--image-key).")
        return
    if found.frozen_frames > MANY_EQUAL:
        yield Problem("repeated-frames", got=equal, expected=f"at most {MANY_EQUAL:.0%}",
                      do="Record actions at the rate of the camera, or leave out steps in which nothing happens.")
    if found.contrast < LITTLE_CONTRAST:
        yield Problem("blank-frames", got=f"pixels deviate by {found.contrast:.1f} grey levels within a frame",
                      expected=f"{LITTLE_CONTRAST:g} or more",
                      do="Look at frames.png: the lens may be covered, or float images may be stored in a wrong range.")


def _action_problems(store: FrameStore, actions: Actions) -> Iterator[Problem]:
    varying = ~actions.constant
    if actions.constant.any():
        which = ", ".join(str(entry) for entry in np.flatnonzero(actions.constant))
        yield Problem("constant-actions", got=f"entries {which} of the actions never vary", expected="every entry to vary",
                      do="Leave them out of the action: policies could put anything there, and no data tell the effect.")
    clipped = varying & (actions.at_bound > MUCH_AT_BOUND)
    if clipped.any():
        which = ", ".join(f"{entry} ({actions.at_bound[entry]:.0%})" for entry in np.flatnonzero(clipped))
        yield Problem("clipped-actions", got=f"entries {which} of the actions lie at a bound",
                      expected=f"at most {MUCH_AT_BOUND:.0%} of them",
                      do="Check whether the recorded commands are scaled as the action space says. A gripper that only "
                         "opens and closes is fine.")
    used = (actions.highest - actions.lowest) / (store.action_high - store.action_low)
    small = varying & (used < SMALL_RANGE)
    if small.any():
        which = ", ".join(f"{entry} ({used[entry]:.1%})" for entry in np.flatnonzero(small))
        yield Problem("small-actions", got=f"entries {which} of the actions use little of the stated range",
                      expected=f"{SMALL_RANGE:.0%} or more",
                      do="State the range that is used as the bounds of the action space: actions are scaled by it, and "
                         "these hardly differ from 0.")
    if actions.autocorrelation[1] < JITTER:
        yield Problem("jittery-actions", got=f"subsequent actions correlate by {actions.autocorrelation[1]:.2f}",
                      expected=f"{JITTER:g} or more",
                      do="Noise that changes every step leads nowhere: hold actions for some steps. Check too whether "
                         "actions and frames belong to the same steps.")


def _coverage_problems(scenes: Scenes, coverage: Coverage | None) -> Iterator[Problem]:
    if scenes.together < 0.1 and scenes.count > 0.5 * len(scenes.episodes) > 2:
        yield Problem("one-episode-a-scene",
                      got=f"{scenes.count} scenes among {len(scenes.episodes)} episodes, and {scenes.together:.0%} of "
                          "subsequent episodes share one",
                      expected="several episodes in each scene",
                      do="Record ten or more episodes before you move anything that they do not move themselves: ways are "
                         "stitched within a scene.")
    if coverage is not None and coverage.lonely > LONELY:
        yield Problem("thin-coverage", got=f"no other episode comes near {coverage.lonely:.0%} of the frames",
                      expected=f"at most {LONELY:.0%}",
                      do="Record more episodes in the same scenes, above all where coverage.png shows lonely frames.")


def inspection_text(inspection: Inspection) -> str:
    """The page: problems first, then the card."""
    lines = [f"# Inspection of {inspection.dataset}", ""]
    lines += [f"- {problem}" for problem in inspection.problems] or ["- nothing stands against a training"]
    if inspection.store is None or inspection.survey is None:
        return "\n".join([*lines, ""])
    lines += ["", *(f"- note: {note}" for note in inspection.notes), *_described(inspection.store, inspection.survey), ""]
    return "\n".join(lines) + "\n" + dataset_card(inspection.store)


def _described(store: FrameStore, found: Survey) -> list[str]:
    """The measurements, one line each."""
    won = episode_returns(store) > 0
    actions = found.actions
    lags = [f"{actions.autocorrelation[lag]:.2f} after {lag}" for lag in (1, 2, 5, 10)
            if np.isfinite(actions.autocorrelation[lag])]
    return [
        f"- success: rule `{store.reading.success or 'none'}`, {won.sum()} of {store.n_episodes} episodes "
        f"({won.mean():.1%})",
        f"- autocorrelation of actions: {', '.join(lags) or 'unknown'} steps",
        f"- at a bound, by entry of the action: {', '.join(f'{share:.0%}' for share in actions.at_bound)}",
        _scenes_line(found.scenes),
        *([] if found.coverage is None else _coverage_lines(found.coverage, bool(won.any())))]


def _scenes_line(scenes: Scenes) -> str:
    if scenes.count == 0:
        return (f"- scenes: unknown. {scenes.still:.0%} of the pixels are still within an episode; scenes are compared from "
                f"{FEWEST_STILL:.0%} on (a moving camera leaves none)")
    count = "one scene" if scenes.count == 1 else f"about {scenes.count} scenes"
    return (f"- scenes: {count} among {len(scenes.episodes)} episodes; {scenes.together:.0%} of subsequent episodes share "
            f"one. Two share a scene where at most {SAME_SCENE:.1%} of the pixels that are still in both differ: smaller "
            "differences are missed, other light counts as another scene")


def _coverage_lines(coverage: Coverage, any_success: bool) -> list[str]:
    lines = [f"- coverage: no other episode comes near {coverage.lonely:.1%} of the frames; at the median "
             f"{np.median(coverage.company):.0f} do. Near: closer than frames {coverage.stride} steps apart usually are, as "
             "pictures of 16 × 16"]
    if any_success and len(coverage.failed_joins):
        ways = coverage.failed_joins[np.isfinite(coverage.failed_joins)]
        usual = f", with {np.median(ways):.0f} changes of episode at the median" if len(ways) else ""
        lines.append(f"- stitching: {coverage.in_reach:.0%} of the episodes without success start where recorded frames "
                     f"lead on to a success{usual} (by the {NEIGHBOURS} nearest frames; a picture may hide what matters)")
    return lines


def inspection_json(inspection: Inspection) -> dict[str, Any]:
    """The same figures for programs; NaN and infinity as None."""
    store, found = inspection.store, inspection.survey
    figures: dict[str, Any] = {"dataset": inspection.dataset, "notes": list(inspection.notes),
                               "problems": [dataclasses.asdict(problem) for problem in inspection.problems]}
    if store is None or found is None:
        return figures
    won = episode_returns(store) > 0
    coverage, scenes, actions = found.coverage, found.scenes, found.actions
    figures |= {
        "episodes": store.n_episodes, "transitions": store.n_transitions, "image": list(store.frames.shape[1:]),
        "length": {"least": int(store.episode_length.min()), "mean": float(store.episode_length.mean()),
                   "most": int(store.episode_length.max())},
        "success": {"rule": store.reading.success, "episodes": int(won.sum()), "rate": float(won.mean())},
        "actions": {"lowest": actions.lowest.tolist(), "highest": actions.highest.tolist(),
                    "low": store.action_low.tolist(), "high": store.action_high.tolist(),
                    "at_bound": actions.at_bound.tolist(), "constant": actions.constant.tolist(),
                    "autocorrelation": [_number(value) for value in actions.autocorrelation]},
        "scenes": {"count": scenes.count or None, "episodes": len(scenes.episodes), "together": _number(scenes.together),
                   "still": scenes.still},
        "frames": {"equal_to_the_one_before": found.frozen_frames, "contrast": found.contrast},
        "content_hash": store.content_hash,
    }
    if coverage is not None:
        figures["coverage"] = {
            "lonely": coverage.lonely, "median_company": float(np.median(coverage.company)), "stride": coverage.stride,
            "in_reach": _number(coverage.in_reach), "success_start_like": _number(coverage.start_like),
            "success_jumps": _number(coverage.jumps)}
    return figures


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def save_inspection(inspection: Inspection, out: Path) -> list[Path]:
    """Write the page, the figures as JSON, and the pictures; returns their paths."""
    paths = [out / PAGE, out / FIGURES]
    text = inspection_text(inspection)
    store, found = inspection.store, inspection.survey
    if store is not None and found is not None:
        out.mkdir(parents=True, exist_ok=True)
        draw_frames(store, out / "frames.png")
        draw_scenes(found, out / "scenes.png")
        paths += [out / "frames.png", out / "scenes.png"]
        if found.coverage is not None:
            draw_coverage(store, found.coverage, out / "coverage.png")
            paths.append(out / "coverage.png")
        text += "".join(f"\n![{path.stem}]({path.name})" for path in paths[2:]) + "\n"
    write_atomic(paths[0], text.encode())
    write_atomic(paths[1], json.dumps(inspection_json(inspection), indent=1, allow_nan=False).encode())
    return paths


def draw_scenes(found: Survey, path: Path) -> None:
    """The background of one episode of each scene, those with most episodes first."""
    scenes = found.scenes
    labels = scenes.labels if scenes.count else np.arange(len(scenes.episodes))
    _, firsts, counts = np.unique(labels, return_index=True, return_counts=True)
    order = np.argsort(-counts, kind="stable")[:SHOWN]
    strip_figure(path, FilmStrip(title="Scenes: what stands still in an episode of each",
                                 frames=scenes.backgrounds[firsts[order]],
                                 captions=tuple(f"{count} episodes" for count in counts[order])))


def draw_coverage(store: FrameStore, coverage: Coverage, path: Path) -> None:
    """Sampled frames in the plane of their first two components by how many other episodes come near; some lonely ones."""
    from matplotlib.colors import LogNorm

    lonely = np.flatnonzero(coverage.company == coverage.company.min())
    lonely = lonely[np.unique(np.linspace(0, len(lonely) - 1, min(SHOWN, len(lonely))).astype(np.int64))]
    figure = new_figure(13, 6, f"{store.dataset_id}: where the data are")
    left, right = figure.subfigures(1, 2, width_ratios=(1.1, 1))
    axes = left.subplots()
    points = axes.scatter(*coverage.plane.T, c=coverage.company + 1, norm=LogNorm(1, max(2, coverage.company.max() + 1)),
                          cmap="viridis", s=5, linewidths=0, rasterized=True)
    left.colorbar(points, label="other episodes that come near, plus 1")
    won = np.flatnonzero((coverage.rows == store.last[coverage.rows])
                         & (episode_returns(store) > 0)[store.episode_of[coverage.rows]])
    axes.scatter(*coverage.plane[won].T, marker="*", s=60, color="tab:orange", edgecolors="black", linewidths=0.6,
                 label=f"successes ({len(won)})")
    axes.set(xlabel="first principal component of the frames", ylabel="second one", xticks=[], yticks=[])
    axes.legend(loc="best", fontsize=8)
    right.suptitle(f"frames with the fewest other episodes near: {coverage.company.min()} (episode:step)", fontsize=10)
    for place, node in zip(right.subplots(4, 6).flat, [*lonely, *[-1] * (SHOWN - len(lonely))], strict=True):
        place.set_axis_off()
        if node >= 0:
            row = coverage.rows[node]
            place.imshow(store.frames[row], interpolation="nearest")
            place.set_title(f"{store.episode_of[row]}:{row - store.first[row]}", fontsize=7)
    save_figure(figure, path)
