# SPDX-License-Identifier: BSD-3-Clause
"""How much a test of reliability tries: a little with every run of the tests, all of it with scripts/reliability."""

from __future__ import annotations

import os
from typing import TypeVar

T = TypeVar("T")

LONG = os.environ.get("ROSBRIDGE_RELIABILITY") == "long"


def effort(short: T, long: T) -> T:
    """`short` in the tests that run every time, `long` in scripts/reliability."""
    return long if LONG else short


def figure(what: str, **values: float) -> None:
    """Shows what was measured: pytest's -rP or -s let it through, as does a failure."""
    shown = ", ".join(f"{name.replace('_', ' ')} {value:.4g}" for name, value in values.items())
    print(f"FIGURE {what}: {shown}")
