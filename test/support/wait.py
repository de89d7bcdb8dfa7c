# SPDX-License-Identifier: BSD-3-Clause
"""Waiting for a condition with a deadline, instead of sleeping and hoping."""

from __future__ import annotations

import time
from typing import Callable, Optional, TypeVar, Union

T = TypeVar("T")

POLL_INTERVAL_S = 0.01


def wait_until(
    condition: Callable[[], Optional[T]], timeout: float = 10.0, message: Union[str, Callable[[], str]] = ""
) -> T:
    """The first truthy value of `condition`, polled; AssertionError with `message` after `timeout`
    seconds."""
    deadline = time.monotonic() + timeout
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() >= deadline:
            text = message() if callable(message) else message
            raise AssertionError(f"not within {timeout:g} s: {text or condition}")
        time.sleep(POLL_INTERVAL_S)
