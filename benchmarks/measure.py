# SPDX-License-Identifier: BSD-3-Clause
"""CPU time and memory of processes, as the kernel counts them: any server can be measured, and doesn't notice."""

from __future__ import annotations

import os
import platform
import time
from pathlib import Path
from typing import Any, Dict, Iterable, List, NamedTuple

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_PROC = Path("/proc")


class Usage(NamedTuple):
    """What processes have used since they started, and hold now."""

    cpu_s: float
    """User and system time of all threads, also of those that have ended."""
    rss_bytes: int


def usage(pids: Iterable[int]) -> Usage:
    """The sum over processes; ProcessLookupError when one has ended."""
    cpu_s, rss_bytes = 0.0, 0
    for pid in pids:
        rss_bytes += int(_stat(pid)[21]) * _PAGE_BYTES
        cpu_s += _cpu_s(pid)
    return Usage(cpu_s, rss_bytes)


def with_descendants(pid: int) -> List[int]:
    """A process and all that it started, directly or not."""
    parents: Dict[int, int] = {}
    for entry in _PROC.iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int(_stat(int(entry.name))[1])
            except ProcessLookupError:
                continue  # ended meanwhile
    found = [pid]
    for ancestor in found:  # grows while it is walked
        found.extend(child for child, parent in parents.items() if parent == ancestor)
    return found


def machine_busy_s() -> float:
    """The CPU time that all processes of the machine have used, in seconds."""
    user, nice, system, _idle, _iowait, irq, softirq, *_ = map(int, (_PROC / "stat").read_text().split()[1:9])
    return (user + nice + system + irq + softirq) / _TICKS_PER_S


def machine() -> Dict[str, Any]:
    """What the figures were measured on."""
    models = [line.split(":", 1)[1].strip() for line in _cpu_info() if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "kernel": platform.release(),
        "python": platform.python_version(),
    }


def _cpu_s(pid: int) -> float:
    """Of all threads of a process; to the nanosecond, where /proc/<pid>/stat counts hundredths of a second."""
    try:
        return time.clock_gettime(~pid << 3 | 2)  # as clock_getcpuclockid(3) has it
    except OSError:
        raise ProcessLookupError(f"no process {pid}") from None


def _cpu_info() -> List[str]:
    return (_PROC / "cpuinfo").read_text().splitlines()


def _stat(pid: int) -> List[str]:
    """The fields of /proc/<pid>/stat after the name: the state is the first."""
    try:
        text = (_PROC / str(pid) / "stat").read_text()
    except FileNotFoundError:
        raise ProcessLookupError(f"no process {pid}") from None
    return text[text.rindex(")") + 2 :].split()
