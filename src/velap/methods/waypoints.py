"""The plans that rows follow, and which waypoint each of them heads for (Alg. 2, B.7).

B environments, P rows, L waypoints of the longest plan held, D latent dimensions.
"""

from __future__ import annotations

import torch
from torch import Tensor

from velap.search.types import SearchFns


class Plans:
    """One path a row: its waypoints, root first, and the one that comes next."""

    def __init__(self, batch: int, device: torch.device) -> None:
        self.waypoints = torch.zeros(batch, 1, 0, device=device)
        """[B, L, D]."""
        self.length = torch.zeros(batch, dtype=torch.long, device=device)
        """[B] nodes of the path, the root included; 0 before the first plan."""
        self.current = torch.zeros(batch, dtype=torch.long, device=device)
        """[B] number of the waypoint that comes next."""

    def forget(self, rows: Tensor) -> None:
        """Rows, bool [B], without a plan."""
        self.length[rows] = 0

    def store(self, rows: Tensor, waypoints: Tensor, length: Tensor) -> None:
        """Plans of `rows` int64 [P]: waypoints [P, L', D] and their number [P]; L grows where needed."""
        width = max(waypoints.shape[1], self.waypoints.shape[1])
        if self.waypoints.shape[1:] != (width, waypoints.shape[2]):
            wider = self.waypoints.new_zeros(len(self.length), width, waypoints.shape[2])
            wider[:, : self.waypoints.shape[1], : self.waypoints.shape[2]] = self.waypoints
            self.waypoints = wider
        self.waypoints[rows, : waypoints.shape[1]] = waypoints.to(self.waypoints.dtype)
        self.length[rows] = length
        self.current[rows] = (length - 1).clamp(max=1)

    def targets(self, rows: Tensor) -> Tensor:
        """The next waypoints [P, D] of `rows` int64 [P]."""
        return self.waypoints[rows, self.current[rows]]

    def ahead(self, row: int) -> Tensor:
        """[L', D] waypoints of `row` that are still ahead, the next one first; empty before the first plan."""
        if self.length[row] == 0:
            return self.waypoints.new_zeros(0, self.waypoints.shape[2])
        return self.waypoints[row, self.current[row] : self.length[row]].clone()

    def advance(self, fns: SearchFns, latents: Tensor, reached: float) -> None:
        """`update_waypoint` of B.7 for latents [B, D]: on to the next one while Q_min(z_curr, z_wp) > τ_wp = `reached`; the
        last one stays."""
        rows = torch.nonzero(self.current < self.length - 1).flatten()
        while len(rows):
            q_min, _ = fns.reach(latents[rows], self.targets(rows))
            rows = rows[q_min > reached]
            self.current[rows] += 1
            rows = rows[self.current[rows] < self.length[rows] - 1]
