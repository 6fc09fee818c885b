"""Updates as CUDA graphs: an update is hundreds of small kernels, and without a graph each costs its launch."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn

from velap.losses import Info


def adam(parameters: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Adam:
    """Adam whose step is one kernel; on CUDA its learning rate is a tensor, so that a graph of the step sees it change."""
    parameters = list(parameters)
    device = parameters[0].device
    if device.type != "cuda":
        return torch.optim.Adam(parameters, learning_rate, fused=True)
    return torch.optim.Adam(parameters, torch.tensor(learning_rate, device=device), fused=True, capturable=True)


def set_rate(optimizer: torch.optim.Optimizer, learning_rate: float) -> None:
    """Set the learning rate of all groups, in place where it is a tensor."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(learning_rate)
        else:
            group["lr"] = learning_rate


class Captured:
    """An update that runs plainly a few times and is then captured as a CUDA graph and replayed.

    It must not look at values on the device (no `.item()`), and whatever it reads or writes must stay where it is. Random
    numbers come from `generator`, which goes on from replay to replay.
    """

    WARM_UP = 3
    """Plain runs before the capture: what is allocated once, such as moments of an optimiser, must not lie in the graph."""

    def __init__(self, update: Callable[[], Info], generator: torch.Generator) -> None:
        self._update, self._generator, self._runs = update, generator, 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._info: Info = {}

    def __call__(self) -> Info:
        """One update; the tensors returned are written again by the next."""
        if self._graph is None and self._runs < self.WARM_UP:
            self._runs += 1
            return self._plain()
        if self._graph is None:
            self._graph = self._capture()
        self._graph.replay()
        return self._info

    def _plain(self) -> Info:
        """On a stream of its own, as the capture will be."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            info = self._update()
        torch.cuda.current_stream().wait_stream(stream)
        return info

    def _capture(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self._generator)
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self._info = self._update()
        return graph
