# SPDX-License-Identifier: BSD-3-Clause
"""Counting what arrives, within a window of time.

What *arrives* in the window gives the rate, and what the server's CPU time is divided by. What was *sent* in the
window, whenever it arrives, gives loss and latency, so that a server isn't credited with what it still holds back.
"""

from __future__ import annotations

import math
import time
from array import array
from typing import Any, Dict, NamedTuple, Sequence

from benchmarks.stamps import NO_STAMP

_NEVER_NS = 1 << 62


class Window(NamedTuple):
    """From `begin_ns` until before `end_ns`, as time.time_ns() counts."""

    begin_ns: int = _NEVER_NS
    end_ns: int = _NEVER_NS

    @property
    def seconds(self) -> float:
        return (self.end_ns - self.begin_ns) / 1e9


class Tally:
    """Counts of one receiving process."""

    def __init__(self) -> None:
        self.window = Window()
        self.arrived = 0
        self.arrived_bytes = 0
        self.stamped = 0
        self.last_ns = time.time_ns()
        """When the last one came."""
        self.latencies_ns = array("q")

    def add(self, stamp_ns: int, size: int, now_ns: int) -> None:
        """Counts a message of `size` bytes that has just arrived."""
        self.last_ns = now_ns
        begin, end = self.window
        if begin <= now_ns < end:
            self.arrived += 1
            self.arrived_bytes += size
            if stamp_ns == NO_STAMP:
                self.stamped += 1
        if begin <= stamp_ns < end:
            self.stamped += 1
            self.latencies_ns.append(now_ns - stamp_ns)

    def summary(self) -> Dict[str, Any]:
        """The counts, and the latencies in milliseconds (None when no stamp could be seen)."""
        ordered = sorted(self.latencies_ns)
        return {
            "arrived": self.arrived,
            "arrived_bytes": self.arrived_bytes,
            "stamped": self.stamped,
            "latency_median_ms": percentile_ms(ordered, 50),
            "latency_p99_ms": percentile_ms(ordered, 99),
        }


def percentile_ms(ordered_ns: Sequence[int], percent: float) -> Any:
    """The nearest-rank percentile of ascending nanoseconds, in milliseconds; None of nothing."""
    if not ordered_ns:
        return None
    rank = max(1, math.ceil(len(ordered_ns) * percent / 100))
    return round(ordered_ns[rank - 1] / 1e6, 3)
