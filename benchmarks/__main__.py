# SPDX-License-Identifier: BSD-3-Clause
"""The command line of the benchmark; see README.md."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import fnmatch
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Dict, Iterator, List, Optional, Sequence, Tuple

from benchmarks import report
from benchmarks.cases import Case, all_cases, matching, quick_cases, usual_cases
from benchmarks.measure import machine
from benchmarks.runner import QUICK, Durations, Runner, run_all
from benchmarks.server import Candidate, candidate, started_environment
from support.ros import RosMaster

CODECS = "codecs"
"""The name, for --only, of the measurement of the codecs alone."""


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """Runs it; the exit code is 1 when a case failed."""
    parser = _parser()
    options = parser.parse_args(arguments)
    cases = quick_cases() if options.quick else all_cases() if options.all else usual_cases()
    cases = matching(cases, options.only)
    with_codecs = not options.only or any(fnmatch.fnmatch(CODECS, pattern) for pattern in options.only)
    if options.list:
        print("\n".join([*(case.name for case in cases), *([CODECS] if with_codecs else [])]))
        return 0
    try:
        if options.compare:
            print(report.compare(*options.compare))
            return 0
        candidates = _candidates(options)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    if not cases and not with_codecs:
        parser.error(f"no case is called {' or '.join(options.only)}; --list names them")
    signal.signal(signal.SIGTERM, _end)
    results = _measure(options, cases, candidates) if cases else []
    if with_codecs:
        results += _measure_codecs(options.quick)
    if options.json:
        _save(options, results)
    print(report.table(results))
    if len(report.servers_of(results)) > 1:
        print("\n" + report.ratios(results))
    return 1 if any("error" in result for result in results) else 0


def _measure(
    options: argparse.Namespace, cases: Sequence[Case], candidates: Sequence[Candidate]
) -> List[Dict[str, Any]]:
    durations = QUICK if options.quick else Durations(window_s=options.seconds)
    _allow_many_connections()
    results: List[Dict[str, Any]] = []
    with contextlib.ExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rosbridge-bench-")))
        uri, environment = stack.enter_context(_ros(options, directory))
        fresh = not options.quick
        runner = stack.enter_context(Runner(uri, started_environment(environment), directory, durations, fresh))
        for result in run_all(runner, cases, candidates):
            results.append(result)
            outcome = "failed" if "error" in result else "skipped" if "skipped" in result else "measured"
            print(f"{result['case']} {result['server']}: {outcome}", file=sys.stderr, flush=True)
            if options.json:
                _save(options, results)  # a run that is broken off has not been for nothing
    return results


def _save(options: argparse.Namespace, results: Sequence[Dict[str, Any]]) -> None:
    date = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    report.save(options.json, {"date": date, "quick": options.quick, "machine": machine(), "results": results})


def _end(_number: int, _frame: object) -> None:
    """SIGTERM ends the run as Ctrl-C does: with all that it has started."""
    raise KeyboardInterrupt


def _measure_codecs(quick: bool) -> List[Dict[str, Any]]:
    """The codecs alone, in a process of their own."""
    with tempfile.NamedTemporaryFile(suffix=".json") as file:
        command = [sys.executable, "-m", "benchmarks.codecs", "--json", file.name, *(["--quick"] if quick else [])]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        print(f"{CODECS}: measured", file=sys.stderr, flush=True)
        return report.codec_results(json.load(file))


def _candidates(options: argparse.Namespace) -> List[Candidate]:
    chosen = [candidate(text) for text in options.server]
    if options.url:
        chosen.append(Candidate(options.name, url=options.url, pid=options.pid))
    return chosen or [candidate("ours")]


@contextlib.contextmanager
def _ros(options: argparse.Namespace, directory: Path) -> Iterator[Tuple[str, Dict[str, str]]]:
    """The URI of the master and the environment of its nodes: a private one, unless a server runs elsewhere."""
    if options.url or options.master:
        uri = options.master or os.environ.get("ROS_MASTER_URI", "http://127.0.0.1:11311")
        yield uri, {**os.environ, "ROS_MASTER_URI": uri}
        return
    with RosMaster(directory) as master:
        yield master.uri, master.environment


def _allow_many_connections() -> None:
    """As many open files as may be: 1000 clients take more than the usual soft limit, here and in the server."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="scripts/bench", description="What a bridge costs; see benchmarks/README.md.")
    parser.add_argument("--quick", action="store_true", help="a few short cases: does it work? (never: how fast?)")
    parser.add_argument("--all", action="store_true", help="every load in every encoding, with 1, 10 and 100 clients")
    parser.add_argument(
        "--server",
        action="append",
        default=[],
        metavar="ours|baseline|NAME=COMMAND",
        help="a server to start, with {port} in its command; several are measured in turn (default: ours)",
    )
    parser.add_argument("--url", help="a rosbridge or Foxglove server that runs already: ws://host:port")
    parser.add_argument("--pid", type=int, help="the process of --url, for its CPU time and memory")
    parser.add_argument("--name", default="url", help="what to call the server of --url")
    parser.add_argument("--master", help="the ROS master to use (default: a private one; with --url: ROS_MASTER_URI)")
    parser.add_argument(
        "--only", action="append", default=[], metavar="PATTERN", help="cases by name, such as 'image/*/10'"
    )
    parser.add_argument("--seconds", type=float, default=Durations().window_s, help="that a case is measured for")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write the results as well")
    parser.add_argument("--list", action="store_true", help="the names of the cases")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("A", "B"), help="the ratios of two result files")
    return parser


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit("interrupted")
