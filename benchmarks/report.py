# SPDX-License-Identifier: BSD-3-Clause
"""Results as a table and as JSON, and the ratios of two files of results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Callable, Dict, Iterable, Iterator, List, Mapping, NamedTuple, Optional, Sequence, Tuple

Result = Dict[str, Any]
FORMAT = 1
CODEC = "codec"
"""The kind of results that need no server."""


class Column(NamedTuple):
    """A column of the table: a field of the results, and how its values look."""

    title: str
    field: str
    show: Callable[[Any], str]


COLUMNS = (
    Column("case", "case", str),
    Column("server", "server", str),
    Column("msg/s", "messages_per_s", "{:.0f}".format),
    Column("MB/s", "megabytes_per_s", "{:.2f}".format),
    Column("loss", "loss", "{:.2%}".format),
    Column("CPU us/msg", "cpu_us_per_message", "{:.1f}".format),
    Column("CPU", "cpu_percent", "{:.1f}%".format),
    Column("RSS MB", "rss_mb", "{:.1f}".format),
    Column("median ms", "latency_median_ms", "{:.2f}".format),
    Column("p99 ms", "latency_p99_ms", "{:.2f}".format),
    Column("other CPU", "other_cpu_percent", "{:.0f}%".format),
    Column("KB/client", "rss_kb_per_client", "{:.1f}".format),
    Column("start s", "startup_s", "{:.2f}".format),
    Column("faster", "times_faster", "{:.1f}x".format),
)
COMPARED = (
    Column("CPU us/msg", "cpu_us_per_message", "{:.1f}".format),
    Column("msg/s", "messages_per_s", "{:.0f}".format),
    Column("median ms", "latency_median_ms", "{:.2f}".format),
    Column("p99 ms", "latency_p99_ms", "{:.2f}".format),
    Column("RSS MB", "rss_mb", "{:.1f}".format),
    Column("CPU %", "cpu_percent", "{:.1f}".format),
    Column("KB/client", "rss_kb_per_client", "{:.1f}".format),
    Column("start s", "startup_s", "{:.2f}".format),
)


def save(path: Path, document: Dict[str, Any]) -> None:
    path.write_text(json.dumps({"format": FORMAT, **document}, indent=1) + "\n", encoding="utf-8")


def load(path: Path) -> List[Result]:
    """The results in a file that `save` wrote. Raises ValueError for any other."""
    document = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"{path} has no results of format {FORMAT}")
    results: List[Result] = document["results"]
    return results


def codec_results(rows: Iterable[Mapping[str, Any]]) -> List[Result]:
    """The rows of benchmarks/codecs.py as results: their CPU time, and how many times faster than genpy with recursive
    conversion that is."""
    return [
        {
            "server": "codecs",
            "case": f"codec/{row['message']}/{conversion}",
            "kind": CODEC,
            "message_bytes": row["bytes"],
            "cpu_us_per_message": round(figures["us"], 2),
            "times_faster": round(figures["times_faster"], 2),
        }
        for row in rows
        for conversion, figures in row.items()
        if isinstance(figures, Mapping)
    ]


def table(results: Sequence[Result]) -> str:
    """Every result that has figures, a line each; then what was skipped or failed."""
    measured = [result for result in results if "skipped" not in result and "error" not in result]
    columns = [column for column in COLUMNS if any(result.get(column.field) is not None for result in measured)]
    rows = [[_cell(column, result) for column in columns] for result in measured]
    lines = _aligned([[column.title for column in columns], *rows]) if rows else []
    notes = [f"{each['case']} {each['server']}: skipped, {each['skipped']}" for each in results if "skipped" in each]
    notes += [f"{each['case']} {each['server']}: FAILED, {each['error']}" for each in results if "error" in each]
    return "\n".join([*lines, *notes])


def ratios(results: Sequence[Result]) -> str:
    """Within one run: each server's figures divided by those of the first one."""
    servers = servers_of(results)
    first = [result for result in results if result["server"] == servers[0]]
    parts = []
    for server in servers[1:]:
        other = [result for result in results if result["server"] == server]
        parts.append(_comparison((servers[0], first), (server, other), _case))
    return "\n\n".join(parts)


def servers_of(results: Iterable[Result]) -> List[str]:
    """The servers that were measured, in their order."""
    return list(dict.fromkeys(str(result["server"]) for result in results if result["kind"] != CODEC))


def compare(a: Path, b: Path) -> str:
    """Two files: the figures of the first divided into those of the second, case by case. The servers of the same name
    are compared or, when there are none, the only server of each file. Raises ValueError."""
    results_a, results_b = load(a), load(b)
    servers_a, servers_b = servers_of(results_a), servers_of(results_b)
    if set(servers_a) & set(servers_b):
        return _comparison((a.name, results_a), (b.name, results_b), lambda each: f"{each['case']} {each['server']}")
    if len(servers_a) == len(servers_b) == 1:
        return _comparison((f"{a.name} {servers_a[0]}", results_a), (f"{b.name} {servers_b[0]}", results_b), _case)
    raise ValueError(f"{a} has {', '.join(servers_a)}, but {b} has {', '.join(servers_b)}")


def _case(result: Result) -> str:
    return str(result["case"])


def _comparison(a: Tuple[str, Sequence[Result]], b: Tuple[str, Sequence[Result]], key: Callable[[Result], str]) -> str:
    by_key = {key(result): result for result in b[1]}
    rows = [["case", "figure", a[0], b[0], "ratio"]]
    for result in a[1]:
        other = by_key.get(key(result))
        if other is not None:
            rows.extend(_rows(key(result), result, other))
    if len(rows) == 1:
        return f"{a[0]} and {b[0]} have no figures of the same case"
    return "\n".join(_aligned(rows))


def _rows(name: str, a: Result, b: Result) -> Iterator[List[str]]:
    for column in COMPARED:
        ratio = _ratio(a.get(column.field), b.get(column.field))
        if ratio is not None:
            yield [name, column.title, _cell(column, a), _cell(column, b), f"{ratio:.2f}"]


def _ratio(a: Any, b: Any) -> Optional[float]:
    """b / a, where both are there."""
    return None if not a or b is None else b / a


def _cell(column: Column, result: Result) -> str:
    value = result.get(column.field)
    return "-" if value is None else column.show(value)


def _aligned(rows: Sequence[Sequence[str]]) -> List[str]:
    """Rows as lines: names to the left, figures to the right."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    return [
        "  ".join(
            cell.ljust(width) if index < 2 else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(row, widths))
        ).rstrip()
        for row in rows
    ]
