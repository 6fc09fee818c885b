"""Tables 1 and 11 of the paper, as data.

Source: VELAP (Value-guided Expansive Latent Planning), CoRL 2023. §5.1, Table 1: "Success rates and std. deviations (%) on
test cases with unseen object variations (except SpiralMaze)". App. E.1, Table 11: "Results of physical robot experiments
(successful episodes)".
"""

from __future__ import annotations

METHODS = ("bc", "bc-success", "td3bc", "iql", "mppi", "mbop", "iris", "iris-multistep", "velap")
"""Columns of Table 1, in its order, in the names of our records."""

TASKS = ("SpiralMaze", "ObstacleMaze", "WindowClose", "FaucetClose", "ButtonWall", "DrawerButton")
"""Rows of Table 1, in its order."""


_ROWS = {
    "SpiralMaze": ((0, 0), (0, 0), (0, 0), (0, 0), (0, 0), (0, 0), (0, 0), (15, 31), (94, 3)),
    "ObstacleMaze": ((0, 0), (15, 6), (35, 22), (6, 3), (83, 11), (40, 25), (50, 25), (62, 14), (97, 2)),
    "WindowClose": ((0, 0), (34, 11), (16, 8), (9, 4), (70, 7), (23, 4), (69, 3), (43, 20), (78, 4)),
    "FaucetClose": ((0, 0), (36, 6), (13, 7), (8, 4), (41, 7), (33, 2), (10, 2), (3, 1), (51, 12)),
    "ButtonWall": ((0, 0), (0, 0), (2, 2), (0, 0), (9, 10), (0, 0), (35, 5), (8, 8), (76, 9)),
    "DrawerButton": ((0, 0), (0, 0), (0, 0), (1, 0), (0, 0), (0, 0), (5, 3), (0, 0), (11, 3)),
}

TABLE_1 = {(task, method): cell for task, row in _ROWS.items() for method, cell in zip(METHODS, row, strict=True)}
"""(task, method) -> success rate and its standard deviation over training runs [%]."""

TASKS_11 = ("Sponge", "Rope")
"""Rows of Table 11, in its order."""
TRIALS_11 = 20
"""Episodes of each cell of Table 11, on one robot."""
TABLE_11 = {
    ("Sponge", "bc"): 5, ("Sponge", "bc-success"): 6, ("Sponge", "iris"): 6, ("Sponge", "velap"): 14,
    ("Rope", "bc"): 0, ("Rope", "bc-success"): 0, ("Rope", "iris"): 2, ("Rope", "velap"): 8,
}
"""(task, method) -> successful episodes."""

ROWS = ("bc", "bc-success", "td3bc", "iql", "iql-sparse", "mppi", "mbop", "iris", "iris-multistep", "velap", "random")
"""Methods in the order of our tables' rows: those of Table 1 and, beside them, ours."""
