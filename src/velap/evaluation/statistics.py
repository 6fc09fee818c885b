"""Statistics over several runs: spread over training seeds, and paired tests of two methods on the same episodes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

from velap.errors import RecordError

Episodes = Mapping[tuple[int, int], bool]
"""(training seed, episode seed) -> success."""


def mean_and_spread(rates: Sequence[float]) -> tuple[float, float]:
    """Mean and sample standard deviation (n - 1) over training seeds, in the unit of `rates`; no spread (NaN) of one."""
    if not rates:
        raise RecordError("there are no runs to average; run `velap table 1` first.")
    return float(np.mean(rates)), float(np.std(rates, ddof=1)) if len(rates) > 1 else math.nan


@dataclass(frozen=True)
class Paired:
    """McNemar's exact test of two methods on the same episodes."""

    episodes: int
    """Pairs."""
    only_first: int
    """Solved by the first method and not by the second."""
    only_second: int
    p_value: float
    """Two-sided; 1 where no pair is discordant."""

    @property
    def discordant(self) -> int:
        """Pairs in which exactly one method succeeds: the test rests on them alone."""
        return self.only_first + self.only_second


def mcnemar(first: Episodes, second: Episodes) -> Paired:
    """Compare two methods on the episodes that both have; raises RecordError where they share none.

    Exact form: under equal success rates each discordant pair falls to either side with probability 1/2.
    """
    shared = first.keys() & second.keys()
    if not shared:
        raise RecordError("the two methods have no episode of the same training and episode seed; evaluate both on the same "
                          "seeds.")
    only_first = sum(first[key] and not second[key] for key in shared)
    only_second = sum(second[key] and not first[key] for key in shared)
    discordant = only_first + only_second
    p_value = float(binomtest(only_first, discordant, 0.5).pvalue) if discordant else 1.0
    return Paired(len(shared), only_first, only_second, p_value)
