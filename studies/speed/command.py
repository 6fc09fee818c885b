"""`velap bench`: speed ratios measured side by side, printed and written as JSON.

A benchmark is a function of `studies.speed.benchmarks` with a line in `BENCHMARKS`.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from studies.speed import benchmarks
from studies.speed.benchmarks import Measurement
from velap.errors import ConfigError
from velap.evaluation.summary import markdown_rows
from velap.runs import write_atomic
from velap.threads import usable_cores
from velap.training.loop import pick_device


@dataclass(frozen=True)
class Benchmark:
    """A registered benchmark and the bound of its ratio."""

    measure: Callable[[torch.device], Measurement]
    at_least: float | None = None
    at_most: float | None = None

    def verdict(self, ratio: float | None) -> str:
        """`wanted ...` with yes or no; empty without a bound or a ratio."""
        if ratio is None or (self.at_least is None and self.at_most is None):
            return "-"
        if self.at_least is not None:
            return f"≥ {self.at_least:g}: {'yes' if ratio >= self.at_least else 'no'}"
        assert self.at_most is not None
        return f"≤ {self.at_most:g}: {'yes' if ratio <= self.at_most else 'no'}"


BENCHMARKS: dict[str, Benchmark] = {
    "train_frames_per_s": Benchmark(benchmarks.train_frames_per_s, at_least=0.8),
    "train_frames_per_s_stack3": Benchmark(partial(benchmarks.train_frames_per_s, frame_stack=3), at_least=0.8),
    "train_minutes": Benchmark(benchmarks.train_minutes),
    "plan_latency_1": Benchmark(partial(benchmarks.plan_latency, batch=1, repeats=9), at_most=1 / 50),
    "plan_latency_1_sim10": Benchmark(partial(benchmarks.plan_latency, batch=1, repeats=9, n_sim=10), at_most=1 / 50),
    "plan_latency_64": Benchmark(partial(benchmarks.plan_latency, batch=64, repeats=3), at_most=1 / 50),
    "env_steps_per_s": Benchmark(partial(benchmarks.env_steps_per_s, name="SpiralMaze"), at_least=10),
    "sawyer_env_steps_per_s": Benchmark(partial(benchmarks.env_steps_per_s, name="WindowClose"), at_least=10),
    "collect_frames_per_s": Benchmark(benchmarks.collect_frames_per_s, at_least=1),
    "train_rss": Benchmark(benchmarks.train_rss, at_most=1),
}
"""Three stacked frames are the default of other tasks; expansions of 10 steps are Table 8's for SpiralMaze, ButtonWall and
DrawerButton, 5 for the others."""


def machine(device: torch.device) -> str:
    """The machine of the measurements."""
    gpu = f", {torch.cuda.get_device_name(device)}" if device.type == "cuda" else ""
    return (f"{hardware()}, {torch.get_num_threads()} threads{gpu}, "
            f"torch {torch.__version__}, Python {platform.python_version()}, {platform.system()}")


def hardware() -> str:
    """Processor and number of cores that this process may use."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        named = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = named[0].partition(":")[2].strip() if named else model
    return f"{model}, {usable_cores()} cores"


def run_benchmarks(console: Console, json_path: Path | None = None, device: str = "auto",
                   only: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Run the benchmarks (those of `only` if it names some), print a table and write the rows to `json_path`."""
    unknown = sorted(set(only) - set(BENCHMARKS))
    if unknown:
        raise ConfigError(f"unknown benchmark {', '.join(unknown)}; expected some of {', '.join(BENCHMARKS)}.")
    place, before = pick_device(device), _read(json_path) if only and json_path is not None else []
    rows: list[dict[str, Any]] = []
    for name in only or BENCHMARKS:
        with console.status(f"measuring {name}"):
            result = BENCHMARKS[name].measure(place)
        rows.append({"name": name, **asdict(result), "ratio": result.ratio, "machine": machine(place)})
    console.print(table(rows), markup=False, soft_wrap=True)
    if json_path is not None:
        merged = {row["name"]: row for row in [*before, *rows]}
        write_atomic(json_path, (json.dumps(list(merged.values()), indent=1, ensure_ascii=False) + "\n").encode())
        console.print(f"written to {json_path}", markup=False)
    return rows


def _read(path: Path) -> list[dict[str, Any]]:
    """Rows of an earlier run, which are kept for benchmarks that are not measured now."""
    if not path.exists():
        return []
    try:
        rows = json.loads(path.read_bytes())
        return [row for row in rows if row["name"] in BENCHMARKS]
    except (ValueError, TypeError, KeyError) as error:
        raise ConfigError(f"{path} does not hold the rows of `velap bench` ({error}); expected a list of them. Name another "
                          "file, or measure everything.") from error


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Rows of `run_benchmarks` for reading, and the machine."""
    lines = []
    for row in rows:
        ratio, reference = row["ratio"], row["reference_value"]
        shown = "-" if ratio is None else f"{ratio:.2f}" if ratio >= 0.1 else f"1/{1 / ratio:.0f}"
        number = "" if reference is None else f"{reference:.4g} {row['unit']}: "
        lines.append((row["name"], f"{row['value']:.4g} {row['unit']}", shown, BENCHMARKS[row["name"]].verdict(ratio),
                      number + row["reference_name"]))
    head = ("benchmark", "value", "ratio", "wanted", "reference")
    return "\n".join([markdown_rows(head, lines), *dict.fromkeys(row["machine"] for row in rows)])
