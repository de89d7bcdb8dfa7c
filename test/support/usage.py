# SPDX-License-Identifier: BSD-3-Clause
"""What a process takes, from /proc: memory, processor time, open files, threads."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Optional, Type

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
MIB = 1 << 20


class Usage(NamedTuple):
    """Of one process, now."""

    rss_mib: float
    cpu_s: float
    open_files: int
    threads: int


def usage(pid: int) -> Usage:
    """Raises OSError when there is no such process."""
    process = Path(f"/proc/{pid}")
    fields = (process / "stat").read_text().rpartition(")")[2].split()  # from the third one on, see proc(5)
    return Usage(
        rss_mib=int(fields[21]) * _PAGE_BYTES / MIB,
        cpu_s=(int(fields[11]) + int(fields[12])) / _TICKS_PER_S,
        open_files=len(os.listdir(process / "fd")),
        threads=int(fields[17]),
    )


class Peak:
    """The most memory that a process had while this was entered: `with Peak(pid) as peak: …`, then `peak.rss_mib`."""

    def __init__(self, pid: int) -> None:
        self.rss_mib = 0.0
        self._pid = pid
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Peak:
        self._thread.start()
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        self._end.set()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            self.rss_mib = max(self.rss_mib, usage(self._pid).rss_mib)
            if self._end.wait(0.1):
                return


def cpu_share(pid: int, seconds: float) -> float:
    """The part of one processor that a process takes during the next so many seconds."""
    begin, before = time.monotonic(), usage(pid).cpu_s
    time.sleep(seconds)
    return (usage(pid).cpu_s - before) / (time.monotonic() - begin)
