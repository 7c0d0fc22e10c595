# SPDX-License-Identifier: GPL-3.0-or-later
"""What a running encode tells its caller: the error over time, the fraction done, and the chance to cancel."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from .workers import INTERVAL, Workers

Progress = Callable[[float], None]


@dataclass
class Monitor:
    """Collects the history of an encode and passes the fraction done to a progress function, which may raise.

    unit: factor from the encoder's squared errors to the signal's. low, high: the range of the fraction that the
    current part of the work covers. workers: who does the steps' work.
    """

    progress: Progress | None = None
    unit: float = 1.0
    low: float = 0.0
    high: float = 1.0
    started: float = field(default_factory=time.perf_counter)
    history: list[tuple[float, str, float]] = field(default_factory=list)
    fraction: float = 0.0
    told: float = 0.0
    prefix: str = ""
    workers: Workers = field(default_factory=Workers)

    def span(self, low: float, high: float, prefix: str = "") -> None:
        """The next part of the work covers this range of the whole; its stages are named with the prefix."""
        self.low, self.high, self.prefix = low, high, prefix

    def note(self, stage: str, error: float, fraction: float) -> None:
        """A stage has ended with a squared error, this fraction of the current part done."""
        self.history.append((time.perf_counter() - self.started, self.prefix + stage, error * self.unit))
        inside = min(max(fraction, 0.0), 1.0)
        self.fraction = max(self.fraction, self.low + (self.high - self.low) * inside)
        self._tell()

    def tick(self) -> None:
        """Within a stage: gives the progress function a chance to cancel, every INTERVAL seconds at most."""
        if time.perf_counter() - self.told >= INTERVAL:
            self._tell()

    def _tell(self) -> None:
        self.told = time.perf_counter()
        if self.progress is not None:
            self.progress(self.fraction)
