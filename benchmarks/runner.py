# SPDX-License-Identifier: BSD-3-Clause
"""Runs a case against a server: starts the parts, opens the window, reads the server's usage at both of its ends."""

from __future__ import annotations

import contextlib
import itertools
import statistics
import time
from pathlib import Path
from typing import Any, Callable, ClassVar, ContextManager, Dict, Iterator, List, NamedTuple, Sequence

from benchmarks import callers, clients, provider, publisher, sender, subscriber
from benchmarks.cases import Case
from benchmarks.measure import Usage, machine_busy_s, usage
from benchmarks.messages import message_bytes
from benchmarks.server import Candidate, Running, running
from benchmarks.tally import Window
from benchmarks.websocket import Connection, Refused
from benchmarks.worker import Worker, WorkerFailed

Result = Dict[str, Any]
_SETTLE_S = 0.05  # for the window to reach all parts before it opens


class Durations(NamedTuple):
    """How long a case takes."""

    warm_up_s: float = 1.0
    window_s: float = 5.0
    idle_s: float = 10.0
    starts: int = 3
    messages: int = 300
    """The least number of messages to measure, for which rare ones get up to three times the window."""

    def of_window_s(self, rate_hz: float) -> float:
        """The length of the window for messages at that rate (0: as many as can be)."""
        wanted_s = self.messages / rate_hz if rate_hz else 0.0
        return max(self.window_s, min(wanted_s, 3 * self.window_s))


QUICK = Durations(warm_up_s=0.1, window_s=0.4, idle_s=0.4, starts=1, messages=1)


class Skipped(Exception):
    """The server doesn't know this; not a failure."""


class Runner:
    """Runs cases in one ROS graph."""

    def __init__(
        self, master_uri: str, environment: Dict[str, str], directory: Path, durations: Durations, fresh: bool
    ) -> None:
        """`fresh`: each case gets a new server; else one server of each kind serves all."""
        self._master_uri = master_uri
        self._environment = environment
        self._directory = directory
        self._durations = durations
        self._fresh = fresh
        self._numbers = itertools.count(1)
        self._shared: Dict[str, Running] = {}
        self._closing = contextlib.ExitStack()

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    def run(self, case: Case, candidate: Candidate) -> Result:
        """The result of one case; with `skipped` or `error`, and no figures, when there is none."""
        result = describe(case, candidate)
        try:
            if case.kind == "startup":
                result.update(self._startup(candidate))
                return result
            if case.encoding not in candidate.encodings:
                raise Skipped(f"{candidate.name} doesn't know {case.encoding}")
            with self._server(candidate) as server:
                _require_protocol(server, case.encoding)
                try:
                    result.update(self._measures[case.kind](self, case, server))
                except WorkerFailed as error:
                    raise RuntimeError(f"{error}{server.log_tail}") from error
        except Skipped as reason:
            result["skipped"] = str(reason)
        except (RuntimeError, OSError) as error:
            result["error"] = str(error)
        return result

    def _server(self, candidate: Candidate) -> ContextManager[Running]:
        if self._fresh:
            return self._start(candidate)
        if candidate.name not in self._shared:
            self._shared[candidate.name] = self._closing.enter_context(self._start(candidate))
        return contextlib.nullcontext(self._shared[candidate.name])

    def _start(self, candidate: Candidate) -> ContextManager[Running]:
        return running(candidate, self._environment, self._directory)

    def _topic(self, case: Case, server: Running) -> Result:
        topic = self._new_name()
        source = Worker(publisher.run, case.load, case.rate_hz, topic, self._master_uri)
        sink = Worker(clients.run, server.url, case.load, case.encoding, topic, case.clients)
        return {"message_bytes": message_bytes(case.load), **self._stream(case, server, source, sink)}

    def _publish(self, case: Case, server: Running) -> Result:
        topic = self._new_name()
        source = Worker(sender.run, server.url, case.encoding, topic, case.rate_hz)
        sink = Worker(subscriber.run, sender.LOAD, topic, self._master_uri)
        return {"message_bytes": message_bytes(sender.LOAD), **self._stream(case, server, source, sink)}

    def _stream(self, case: Case, server: Running, source: Worker, sink: Worker) -> Result:
        """What comes out at `sink` of what goes in at `source`."""
        with source, sink:
            source.reply()
            sink.ask("start")
            result = self._window(case, server, [source, sink], [source, sink])
            sent, received = source.ask("stop"), sink.ask("finish")
        return {**result, **_losses(case, sent, received), **_figures(result, received)}

    def _service(self, case: Case, server: Running) -> Result:
        service = self._new_name()
        source = Worker(provider.run, service, self._master_uri)
        sink = Worker(callers.run, server.url, case.encoding, service, case.clients)
        with source, sink:
            source.reply()
            sink.ask("start")
            result = self._window(case, server, [source, sink], [sink])
            received = sink.ask("finish")
        return {**result, **_figures(result, received)}

    def _idle(self, case: Case, server: Running) -> Result:
        if not server.pids:
            raise Skipped("the server's process is unknown")
        before = usage(server.pids)
        with Worker(clients.run_idle, server.url, case.encoding, case.clients) as sink:
            sink.reply()
            time.sleep(self._durations.warm_up_s)
            begin, begin_s = usage(server.pids), time.monotonic()
            time.sleep(self._durations.idle_s)
            end, seconds = usage(server.pids), time.monotonic() - begin_s
        return {
            "seconds": round(seconds, 3),
            "cpu_percent": round(100 * (end.cpu_s - begin.cpu_s) / seconds, 2),
            "rss_mb": round(end.rss_bytes / 1e6, 1),
            "rss_kb_per_client": round((end.rss_bytes - before.rss_bytes) / 1e3 / case.clients, 1),
        }

    _measures: ClassVar[Dict[str, Callable[[Runner, Case, Running], Result]]] = {
        "topic": _topic,
        "publish": _publish,
        "service": _service,
        "idle": _idle,
    }

    def _startup(self, candidate: Candidate) -> Result:
        """The median time from start to listening, and what the server then holds."""
        seconds: List[float] = []
        held = Usage(0.0, 0)
        for _ in range(self._durations.starts):
            with self._start(candidate) as server:
                if server.startup_s is None:
                    raise Skipped("the server was not started here")
                seconds.append(server.startup_s)
                held = usage(server.pids)
        return {"startup_s": round(statistics.median(seconds), 3), "rss_mb": round(held.rss_bytes / 1e6, 1)}

    def _window(self, case: Case, server: Running, workers: Sequence[Worker], counting: Sequence[Worker]) -> Result:
        """Warms up and opens a window; the server's usage in it, and that of processes which don't belong here."""
        time.sleep(self._durations.warm_up_s)
        begin_ns = time.time_ns() + int(_SETTLE_S * 1e9)
        window = Window(begin_ns, begin_ns + int(self._durations.of_window_s(case.rate_hz) * 1e9))
        for worker in counting:
            worker.tell(window)
        ours = [worker.pid for worker in workers]
        _sleep_until(window.begin_ns)
        server_begin, ours_begin, machine_begin = usage(server.pids), usage(ours), machine_busy_s()
        _sleep_until(window.end_ns)
        server_end, ours_end, machine_end = usage(server.pids), usage(ours), machine_busy_s()
        seconds = window.seconds
        cpu_s = server_end.cpu_s - server_begin.cpu_s
        result: Result = {"seconds": seconds}
        if server.pids:
            others_s = machine_end - machine_begin - cpu_s - (ours_end.cpu_s - ours_begin.cpu_s)
            result["cpu_s"] = round(cpu_s, 6)
            result["cpu_percent"] = round(100 * cpu_s / seconds, 1)
            result["rss_mb"] = round(server_end.rss_bytes / 1e6, 1)
            result["other_cpu_percent"] = round(max(0.0, 100 * others_s / seconds), 1)
        return result

    def _new_name(self) -> str:
        """A topic or service that nobody has used."""
        return f"/benchmark/{time.time_ns():x}_{next(self._numbers)}"


def describe(case: Case, candidate: Candidate) -> Result:
    """What a result begins with."""
    return {
        "server": candidate.name,
        "case": case.name,
        "kind": case.kind,
        "load": case.load,
        "encoding": case.encoding,
        "clients": case.clients,
        "rate_hz": case.rate_hz,
    }


def run_all(runner: Runner, cases: Sequence[Case], candidates: Sequence[Candidate]) -> Iterator[Result]:
    """The results, each as soon as it is there. The servers take turns within a case, so that what else the machine
    does hits them alike."""
    for case in cases:
        for candidate in candidates:
            yield runner.run(case, candidate)


def _losses(case: Case, sent: Result, received: Result) -> Result:
    expected = sent["sent"] * case.clients
    loss = round(1 - received["stamped"] / expected, 5) if expected else None
    return {"sent": sent["sent"], "publisher_dropped": sent["dropped"], "loss": loss}


def _figures(usage_: Result, received: Result) -> Result:
    seconds, arrived = usage_["seconds"], received["arrived"]
    result: Result = {
        "messages_per_s": round(arrived / seconds, 1),
        "megabytes_per_s": round(received["arrived_bytes"] / seconds / 1e6, 3),
        "latency_median_ms": received["latency_median_ms"],
        "latency_p99_ms": received["latency_p99_ms"],
    }
    if "cpu_s" in usage_ and arrived:
        result["cpu_us_per_message"] = round(usage_["cpu_s"] / arrived * 1e6, 1)
    return result


def _require_protocol(server: Running, encoding: str) -> None:
    """Raises Skipped when the server doesn't speak the protocol of an encoding."""
    try:
        Connection(server.url, foxglove=encoding == "foxglove").close()
    except Refused as reason:
        raise Skipped(str(reason)) from None


def _sleep_until(time_ns: int) -> None:
    time.sleep(max(0.0, (time_ns - time.time_ns()) / 1e9))
