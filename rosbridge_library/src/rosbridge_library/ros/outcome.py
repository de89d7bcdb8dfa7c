# SPDX-License-Identifier: BSD-3-Clause
"""Tasks that several may wait for, through `asyncio.shield`, and that end also when none of them waits any more."""

from __future__ import annotations

import asyncio
from typing import Any


def know_outcome(task: asyncio.Future[Any]) -> None:
    """A done callback: a failure concerns only those who still wait, and asyncio need not log that nobody did."""
    if not task.cancelled():
        task.exception()
