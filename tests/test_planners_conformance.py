"""Conformance over the registry: every planner obeys the `Planner` protocol on the exact toy world."""

from __future__ import annotations

import pytest
import torch

from toy_world import algorithm_1, roots, row_generators, toy_fns
from velap.registry import PLANNERS
from velap.search.types import Path

CONFIG = algorithm_1(n_iter=60, candidates=20, n_sim=3)
every_planner = pytest.mark.parametrize("name", PLANNERS)


def plan(name: str, z_root: torch.Tensor, first_seed: int = 0) -> Path:
    return PLANNERS[name](toy_fns(), z_root, CONFIG, row_generators(len(z_root), first_seed))


@every_planner
def test_a_path_begins_at_its_root_and_repeats_its_end(name: str) -> None:
    z_root = roots(4, spread=3.0)
    found = plan(name, z_root)
    batch, width, dim = found.waypoints.shape
    assert (batch, dim) == (4, 2)
    assert found.length.shape == (4,) and found.length.dtype == torch.int64
    assert ((found.length >= 1) & (found.length <= width)).all()
    torch.testing.assert_close(found.waypoints[:, 0], z_root)
    for row in range(4):
        behind = found.waypoints[row, int(found.length[row]) :]
        torch.testing.assert_close(behind, found.waypoints[row, int(found.length[row]) - 1].expand_as(behind))


@every_planner
def test_a_row_is_planned_by_its_own_generator_alone(name: str) -> None:
    z_root = roots(3, spread=3.0)
    together = plan(name, z_root, first_seed=5)
    for row in range(3):
        alone, length = plan(name, z_root[row : row + 1], first_seed=5 + row), int(together.length[row])
        assert int(alone.length[0]) == length
        torch.testing.assert_close(alone.waypoints[0, :length], together.waypoints[row, :length])
