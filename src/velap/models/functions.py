"""The model as search sees it: callables and numbers, no network.

`*` is any batch prefix, R rows, S noises of a simulation, D latent, A action, m noise dimension.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor


class SearchFns(NamedTuple):
    """The model as search sees it (Eq. 1): callables over any batch prefix, without gradients, safe to call with 0 rows."""

    propose: Callable[[Tensor, Tensor], Tensor]
    """g: latents [*, D], standard normal noise [*, m] → actions [*, A] in [-1, 1]."""
    act_global: Callable[[Tensor], Tensor]
    """π^g: latents [*, D] → actions [*, A] in [-1, 1]."""
    step: Callable[[Tensor, Tensor], Tensor]
    """h: latents [*, D], actions [*, A] → latents [*, D] one step later."""
    reach: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    """Q^l: from [*, D], to [*, D] → ensemble minimum [*] and standard deviation [*] [Q-value] of going there by π^l."""
    value: Callable[[Tensor], Tensor]
    """Q^g(z, π^g(z)): latents [*, D] → [*] [Q-value]."""
    q: Callable[[Tensor, Tensor], Tensor]
    """Q^g: latents [*, D], actions [*, A] → [*] [Q-value]."""
    noise_dim: int
    """m."""
    discount: float
    """γ, Table 7."""
    d_neigh: float
    """Radius of the candidate neighbours, Table 8 [latent distance]."""
    step_distance: float
    """Upper 5-percentile of the distances between subsequent encodings [latent distance]."""
    project: Callable[[Tensor], tuple[Tensor, Tensor]] | None = None
    """Latents [*, D] → nearest dataset latent [*, D] and its distance [*]; None where the model keeps no bank."""
    success_share: float = 1.0
    """Share of the data's episodes that succeed; see `velap.config.planning.has_provenance`."""
    arrival_rates: tuple[float, float] = (0.0, 0.0)
    """How often π^g and `act_success` get to the goal by h from far away: who of them proposes edges (ours)."""
    snaps: bool = False
    """Anchors of the search move its candidates to `project` where its config leaves that to the model (ours)."""
    act_success: Callable[[Tensor], Tensor] | None = None
    """The policy cloned from successes: latents [*, D] → actions [*, A] in [-1, 1]; None where the model has none (ours)."""
    rollout: Callable[[Tensor, Tensor | None, int], Tensor] | None = None
    """Latents [R, D], noise of g [R, S, m] or None for π^g, a number of steps [steps] → latents [R, D] after them, the
    noise of step i being number min(i, S - 1): what `propose`, `act_global` and `step` give together. None calls them."""
