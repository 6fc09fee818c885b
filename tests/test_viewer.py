"""`velap view`: the trace of an episode holds what the agent did, and the page shows it in a browser without a network."""

from __future__ import annotations

import http.server
import json
import re
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from toy_env import ToyEnv, ToyModel, draw, read, toy_config, toy_player
from toy_world import GOAL
from velap.cli import main
from velap.config import override
from velap.errors import ConfigError
from velap.evaluation.evaluate import Player, to_record
from velap.evaluation.rollout import Episode
from velap.methods.base import make_agent
from velap.methods.tree_agent import Actor
from velap.methods.velap import VelapAgent
from velap.report import viewer, viewer_page
from velap.report.figures import RealStates
from velap.report.viewer import Subject, Trace, backdrop_of, subject_of, trace
from velap.report.viewer_page import GRID, LARGEST, MARK, episode_data, page
from velap.search import est
from velap.search import types as search

SEED = 3
ORANGE, BLUE = (213, 94, 0), (0, 114, 178)


@pytest.fixture(scope="module")
def player() -> Player:
    return toy_player()


@pytest.fixture(scope="module")
def seen(player: Player) -> Trace:
    return trace(player, SEED)


@pytest.fixture(scope="module")
def backdrop(player: Player) -> RealStates:
    found = backdrop_of(player, SEED, count=200)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def subject(player: Player) -> Subject:
    episodes = [Episode(SEED, True, 21, False, ()), Episode(4, False, 60, True, ())]
    records = tuple(to_record(player.key, episode, 1, player.device) for episode in episodes)
    return Subject(player=player, seed=SEED, records=records)


# the trace


def test_a_trace_is_the_episode_that_a_rollout_gives(player: Player, seen: Trace) -> None:
    (episode,) = player.episodes([SEED])
    assert (seen.outcome.success, seen.outcome.steps) == (episode.success, episode.steps) and episode.success
    assert len(seen.steps) == episode.steps
    assert len(seen.plans) == len(episode.plan_ms)


def test_a_step_holds_world_latent_and_value(player: Player, seen: Trace) -> None:
    """The toy's latent is the position, which its pictures show."""
    assert player.model is not None
    for step in seen.steps:
        np.testing.assert_allclose(read(torch.from_numpy(step.picture[None])).numpy(), step.latent, atol=1e-6)
        assert step.value == pytest.approx(float(player.model.value(torch.tensor(step.latent)[None].double())), rel=1e-4)
    assert np.linalg.norm(read(torch.from_numpy(seen.last_picture[None])).numpy() - GOAL) < 1.1


def test_plans_are_kept_when_they_are_made(player: Player, seen: Trace) -> None:
    period = player.config.controller.n_replan
    assert [plan.step for plan in seen.plans] == list(range(0, 10 * len(seen.plans), period))
    for number, plan in enumerate(seen.plans):
        np.testing.assert_allclose(plan.latents[0], seen.steps[plan.step].latent, atol=1e-6)
        assert plan.path[0] == 0
        assert (plan.parents[plan.path[1:]] == plan.path[:-1]).all(), "the path follows the tree"
        assert plan.milliseconds > 0
        assert seen.steps[plan.step].plan == number
    assert len(seen.plans[0].latents) > 20


def test_waypoints_come_in_turn_until_the_goal_is_near(seen: Trace) -> None:
    stop = next((number for number, step in enumerate(seen.steps) if step.actor == Actor.GOAL), len(seen.steps))
    assert {step.actor for step in seen.steps[:stop]} == {Actor.LOCAL}
    for before, after in zip(seen.steps[: stop - 1], seen.steps[1:stop], strict=True):
        assert before.waypoint is not None and after.waypoint is not None
        assert after.plan != before.plan or after.waypoint >= before.waypoint
    assert max(step.waypoint or 0 for step in seen.steps) > 1


def test_who_proposed_an_edge_is_told_apart_from_who_leads_nowhere() -> None:
    proposed = toy_player(n_iter=300, provenance=True)
    actors = {step.actor for step in trace(proposed, SEED).steps}
    assert {Actor.LOCAL, Actor.POLICY} <= actors, "g around the wall, π^g before and behind it"
    for step in trace(proposed, SEED).steps:
        assert (step.waypoint is None) == (step.actor in (Actor.GOAL, Actor.NOWHERE))
    nowhere = toy_player(max_steps=4, n_iter=1)
    assert [step.actor for step in trace(nowhere, SEED).steps][-1] in (Actor.LOCAL, Actor.NOWHERE)


def test_another_method_shows_its_frames_alone(player: Player) -> None:
    other = replace(player, agent=make_agent("random", None, player.config, ToyEnv().action_space))  # type: ignore[arg-type]
    found = trace(other, SEED)
    assert found.plans == () and found.steps[0].latent is None
    data = episode_data(Subject(player=other, seed=SEED), found, None, "pca")
    assert data["trail"] == [] and data["values"] == [None] * len(found.steps)


def test_a_world_that_draws_nothing_shows_what_the_agent_sees(player: Player, seen: Trace,
                                                              monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(ToyEnv, "free_positions")
    monkeypatch.setattr(ToyEnv, "render_mode", None)
    for step, drawn in zip(trace(player, SEED).steps, seen.steps, strict=True):
        np.testing.assert_array_equal(step.picture, drawn.picture)


# real states


def test_the_backdrop_shows_what_a_latent_looks_like(backdrop: RealStates) -> None:
    assert backdrop.source == "the episode's scene"
    wanted = np.array([GOAL, (-3.0, 2.0)], np.float32)
    found, away = backdrop.nearest(wanted)
    np.testing.assert_allclose(np.linalg.norm(backdrop.latents[found] - wanted, axis=1), away, rtol=1e-5)
    assert (away == np.linalg.norm(backdrop.latents[:, None] - wanted, axis=-1).min(0)).all() or away.max() < 2
    np.testing.assert_allclose(backdrop.frames[found[0]], draw(backdrop.latents[found[0]]), atol=1)


# the page


def data_of(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_the_page_holds_the_episode(subject: Subject, seen: Trace, backdrop: RealStates) -> None:
    text = page(subject, seen, backdrop)
    assert MARK not in text and len(text.encode()) < LARGEST
    data = data_of(text)
    assert data["title"] == f"toy, episode of seed {SEED}: solved in {seen.outcome.steps} steps"
    assert len(data["frames"]) == len(seen.steps) + 1
    assert all(frame.startswith("data:image/webp;base64,") for frame in [*data["frames"], *data["tiles"].values()])
    assert data["projection"] == "Isomap"
    for plan, shown in zip(seen.plans, data["plans"], strict=True):
        assert (len(shown["points"]), len(shown["values"]), len(shown["strip"])) == (
            len(plan.latents), len(plan.latents), len(plan.path))
    nodes = [point for plan in data["plans"] for point in plan["points"]]
    points = np.array([*data["trail"], *data["backdrop"]["points"], *nodes])
    assert (points.min(), points.max()) == (0, GRID)
    assert data["records"] == [{"seed": 3, "success": True, "steps": 21}, {"seed": 4, "success": False, "steps": 60}]


def test_principal_components_of_a_plane_keep_its_distances(subject: Subject, seen: Trace, backdrop: RealStates) -> None:
    data = episode_data(subject, seen, backdrop, "pca")
    shown = np.array(data["backdrop"]["points"], float)
    drawn, true = (np.linalg.norm(np.diff(points, axis=0), axis=1) for points in (shown, backdrop.latents))
    np.testing.assert_allclose(drawn / drawn.mean(), true / true.mean(), atol=0.02)


def test_only_what_belongs_to_the_page_is_named_in_it(subject: Subject, seen: Trace, backdrop: RealStates) -> None:
    text = page(subject, seen, backdrop)
    assert set(re.findall(r"\w+://[^\s\"'<>]+", text)) == {"http://www.w3.org/2000/svg"}  # a name, never fetched
    assert "default-src 'none'" in text


def test_markup_in_names_stays_text(player: Player, seen: Trace) -> None:
    named = replace(player, key=replace(player.key, task="</script><b>x"))
    text = page(Subject(player=named, seed=SEED), seen, None)
    assert data_of(text)["title"].startswith("</script><b>x")
    assert "</script><b>" not in text


def test_a_long_episode_gets_smaller_pictures_then_a_named_error(subject: Subject, seen: Trace,
                                                                 monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    steps = (replace(step, picture=rng.integers(0, 256, (256, 256, 3), np.uint8)) for step in seen.steps)
    noisy = replace(seen, steps=tuple(steps))
    full = len(page(subject, noisy, None).encode())
    monkeypatch.setattr(viewer_page, "LARGEST", full // 3)
    assert len(page(subject, noisy, None).encode()) <= full // 3
    monkeypatch.setattr(viewer_page, "LARGEST", 1000)
    with pytest.raises(ConfigError, match=r"takes [\d,]+ bytes; expected at most 1,000. View a shorter episode"):
        page(subject, noisy, None)


# in a browser

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: `apt-get install chromium` runs this test")


@dataclass
class Site:
    """A folder that is served to this machine alone."""

    folder: Path
    port: int
    asked: list[str]
    """Paths that were asked for."""


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    folder, asked = tmp_path / "site", []
    folder.mkdir()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments, directory=str(folder))  # type: ignore[arg-type]

        def log_message(self, *_: object) -> None:
            asked.append(self.path)

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield Site(folder, server.server_port, asked)
        server.shutdown()


def browse(site: Site, name: str, *options: str) -> tuple[str, list[str]]:
    """Open a page in a browser that reaches this machine alone; what it printed, and lines of its console."""
    assert CHROMIUM is not None
    done = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync", "--hide-scrollbars", "--enable-logging=stderr",
         "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", f"--user-data-dir={site.folder.parent / 'profile'}",
         "--virtual-time-budget=3000", "--window-size=1180,1400", *options, f"http://127.0.0.1:{site.port}/{name}"],
        capture_output=True, text=True, timeout=100, check=True)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


@needs_browser
def test_what_a_browser_would_complain_about_is_noticed(site: Site) -> None:
    """The next tests can fail."""
    (site.folder / "bad.html").write_text('<img src="missing.png"><script>nothing()</script>')
    _, console = browse(site, "bad.html", "--dump-dom")
    assert any("nothing is not defined" in line for line in console)
    assert any("/missing.png" in path for path in site.asked)


@needs_browser
def test_a_browser_shows_the_episode_without_error_or_request(site: Site, subject: Subject, seen: Trace,
                                                              backdrop: RealStates) -> None:
    (site.folder / "page.html").write_text(page(subject, seen, backdrop), encoding="utf-8")
    middle = seen.plans[1].step + 2
    dom, console = browse(site, f"page.html#step={middle}", "--dump-dom")
    assert console == []
    assert site.asked == ["/page.html"]
    plan, step = seen.plans[1], seen.steps[middle]
    assert f"toy, episode of seed {SEED}: solved in {seen.outcome.steps} steps</h1>" in dom
    assert f"step {middle} of {len(seen.steps)}" in dom
    assert f"heads for waypoint <b>{step.waypoint} of {len(plan.path) - 1}</b>" in dom
    assert f"Plan of step {plan.step}: {len(plan.path) - 1} waypoint" in dom
    assert dom.count("<figure") == len(plan.path)
    assert dom.count('<figure class="next">') == 1
    pairs = [(before, after) for before, after in zip(seen.steps, seen.steps[1:], strict=False)
             if before.waypoint is not None and after.waypoint is not None and after.plan == before.plan]
    switches = sum(before.waypoint != after.waypoint for before, after in pairs)
    assert dom.count('class="switch"') == switches > 0
    assert len(re.findall(r"<title>step \d+: \d+ nodes", dom)) == len(seen.plans)
    assert "Recorded episodes: 1 of 2 solved" in dom and dom.count("✗</i>") == 1


def map_of(path: Path) -> np.ndarray:
    """int [h, w, 3] the latent map of a screenshot."""
    return np.asarray(Image.open(path).convert("RGB")).astype(int)[105:565, 380:1150]


def pixels_of(path: Path, colour: tuple[int, int, int]) -> int:
    return int((np.abs(map_of(path) - colour).sum(-1) < 12).sum())


def grey_pixels_of(path: Path) -> int:
    """Edges and outlines of the tree."""
    shown = map_of(path)
    return int(((np.ptp(shown, axis=-1) < 24) & (shown.mean(-1) < 190)).sum())


@needs_browser
def test_the_tree_grows_and_the_chosen_path_comes_last(site: Site, subject: Subject, seen: Trace,
                                                       backdrop: RealStates) -> None:
    """Screenshots: no path while the tree is unfinished, a longer way behind the agent later on."""
    (site.folder / "page.html").write_text(page(subject, seen, backdrop), encoding="utf-8")
    shots = {}
    for name, at in (("few", "step=0&nodes=5"), ("half", "step=0&nodes=25"), ("whole", "step=0"), ("end", "step=999")):
        shots[name] = site.folder.parent / f"{name}.png"
        assert browse(site, f"page.html#{at}", f"--screenshot={shots[name]}")[1] == []
    assert grey_pixels_of(shots["few"]) < grey_pixels_of(shots["half"]) < grey_pixels_of(shots["whole"]) * 1.2
    assert pixels_of(shots["half"], ORANGE) < pixels_of(shots["whole"], ORANGE) / 2
    assert pixels_of(shots["end"], BLUE) > 3 * pixels_of(shots["whole"], BLUE)


# the command


@pytest.fixture
def toy_at_hand(monkeypatch: pytest.MonkeyPatch) -> Callable[[Player], None]:
    def put(player: Player) -> None:
        monkeypatch.setattr(viewer, "load_player", lambda what: player)

    return put


def record_file(player: Player, path: Path, seeds: tuple[int, ...]) -> Path:
    lines = [to_record(player.key, Episode(seed, seed != 2, 21, seed == 2, ()), 1, "cpu").to_json() for seed in seeds]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_records_are_viewed_at_their_first_failure(player: Player, tmp_path: Path,
                                                   toy_at_hand: Callable[[Player], None]) -> None:
    toy_at_hand(player)
    records = record_file(player, tmp_path / "train0.jsonl", (0, 1, 2, 3))
    assert subject_of(records).seed == 2
    assert subject_of(records, episode_seed=1).seed == 1
    with pytest.raises(ConfigError, match="no episode of seed 9; expected one from 0 to 3"):
        subject_of(records, episode_seed=9)


def test_records_of_other_weights_are_refused(player: Player, tmp_path: Path, toy_at_hand: Callable[[Player], None]) -> None:
    toy_at_hand(player)
    other = replace(player, key=replace(player.key, checkpoint="ab" * 32))
    records = record_file(other, tmp_path / "train0.jsonl", (0,))
    with pytest.raises(ConfigError, match=r"made by the weights abababababab…, .* Name the right file"):
        subject_of(records, checkpoint=tmp_path / "model.safetensors")
    with pytest.raises(ConfigError, match="toy has no released one; expected its path"):
        subject_of(records)


def test_the_command_writes_a_page_and_says_where_it_differs_from_the_record(
        player: Player, tmp_path: Path, toy_at_hand: Callable[[Player], None], capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch) -> None:
    toy_at_hand(player)
    monkeypatch.chdir(tmp_path)
    records = record_file(player, tmp_path / "train0.jsonl", (2,))
    assert main(["view", str(records), "--projection", "pca"]) == 0
    said = capsys.readouterr()
    path = tmp_path / "runs/view/toy-velap-seed2.html"
    assert f"page {path.relative_to(tmp_path)}, 0." in said.out
    assert "the record says not solved in 21 steps, this run solved in" in said.err
    assert data_of(path.read_text())["seed"] == 2


def test_a_planner_without_a_tree_shows_its_waypoints(player: Player) -> None:

    def bare(fns, roots, config, generator):  # type: ignore[no-untyped-def]
        found = est.plan(fns, roots, config, generator)
        return search.Path(found.waypoints, found.length)

    agent = VelapAgent(ToyModel(), override(toy_config(n_iter=300)), bare)  # type: ignore[arg-type]
    found = trace(replace(player, agent=agent), SEED)
    assert found.plans[0].reached_goal is None
    assert (found.plans[0].path == np.arange(len(found.plans[0].latents))).all()
    data = episode_data(Subject(player=player, seed=SEED), found, None, "isomap")
    assert data["projection"] == "principal components" and data["plans"][0]["strip"] == []
