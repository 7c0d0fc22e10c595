# SPDX-License-Identifier: GPL-3.0-or-later
"""What an encode is asked for, checked before any work."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..errors import BadArguments

METHODS = ("static", "iterative", "adaptive")


@dataclass(frozen=True)
class EncoderSettings:
    """What an encode is asked for.

    clusters, vectors: the paper's m_c and n', both upper limits: fewer are used where the signal needs fewer.
    method: "static" (section 4.1), "iterative" (4.2) or "adaptive" (4.3).
    seed: of the random starts; the same seed gives the same result.
    iterations: most LBG iterations per number of vectors.
    target_error: squared error relative to the signal's own sum of squares at which to stop; None uses every cluster
        and vector. The error reached is at most this wherever the clusters and vectors allowed suffice.
    vectors_limit: most vectors of one cluster in the adaptive method; None allows twice `vectors`.
    tolerance: relative decrease of the squared error below which iterations stop; a tenth of the default lowers the
        error by some 4 % in two to three times the time.
    restarts: how many of the paper's random starts to try beside the splits; None lets the signal's size decide, and a
        target_error makes do with the splits.
    together: vectors that are added together while wide signals are iterated; more end sooner, with a little more
        error.
    threads: that work at the same time, 0 = one for each core; the result does not depend on it.
    """

    clusters: int = 256
    vectors: int = 8
    method: str = "iterative"
    seed: int = 0
    iterations: int = 20
    target_error: float | None = None
    vectors_limit: int | None = None
    tolerance: float = 0.0075
    restarts: int | None = None
    together: int = 1
    threads: int = 0

    def __post_init__(self) -> None:
        """Raises BadArguments where a setting makes no sense."""
        if self.clusters < 1:
            raise BadArguments("clusters", f"{self.clusters} is not a number of clusters", "Use 1 or more")
        if self.vectors < 0:
            raise BadArguments("vectors", f"{self.vectors} is not a number of vectors", "Use 0 or more")
        if self.method not in METHODS:
            raise BadArguments("method", f"{self.method!r} is not an encoder", f"Use one of {', '.join(METHODS)}")
        if self.iterations < 1:
            raise BadArguments("iterations", f"{self.iterations} iterations do nothing", "Use 1 or more")
        if self.target_error is not None and not (math.isfinite(self.target_error) and self.target_error >= 0):
            raise BadArguments("target_error", f"{self.target_error} is not a relative error", "Use 0 or more, or None")
        if self.vectors_limit is not None and self.vectors_limit < self.vectors:
            raise BadArguments("vectors_limit", "it is below the number of vectors", f"Use {self.vectors} or more")
        if self.restarts is not None and self.restarts < 0:
            raise BadArguments("restarts", f"{self.restarts} is not a number of starts", "Use 0 or more, or None")
        if self.together < 1:
            raise BadArguments("together", "no vector is added", "Use 1 or more")
        if self.threads < 0:
            raise BadArguments("threads", f"{self.threads} is not a number of threads", "Use 0 or more")
        if not (math.isfinite(self.tolerance) and self.tolerance >= 0):
            raise BadArguments("tolerance", f"{self.tolerance} is not a relative decrease", "Use 0 or more")

    @property
    def most_vectors(self) -> int:
        """The largest number of vectors that one cluster may get."""
        if self.method != "adaptive":
            return self.vectors
        return 2 * self.vectors if self.vectors_limit is None else self.vectors_limit
