# SPDX-License-Identifier: BSD-3-Clause
"""The bridge under a mixed load for as long as one likes, with its memory and processor time plotted: scripts/soak.

Clients in every encoding watch an image, a state topic and a latched map; one is behind a slow link and one stops every
now and then; others publish, call a service of a node and one of a client; and clients come, begin things and go, all
the time. It fails when something stops, when the server logs an error, or when its memory is not flat.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Callable, List, NamedTuple

from support.bridge import Bridge
from support.link import Link
from support.node import _PROGRAMS, serve
from support.peer import Peer
from support.ros import RosMaster, python
from support.usage import usage
from support.viewer import Viewer, sensors, subscription

ADD, INT32 = "rosbridge_library/AddTwoInts", "std_msgs/Int32"
SAMPLE_INTERVAL_S = 1.0
SLEEP_S, AWAKE_S = 5.0, 10.0
FLAT_MIB = 10.0
"""How much more the server may have in the last third of the time than in the middle one."""


class Sample(NamedTuple):
    """What the server takes at a time; `cpu_percent` of one processor, since the sample before."""

    minute: float
    rss_mib: float
    cpu_percent: float
    open_files: int
    threads: int


class Work:
    """What goes on beside the viewers, each in a thread, again and again; a failure ends the soak."""

    def __init__(self) -> None:
        self.failures: List[str] = []
        self.counts = {}
        self._end = threading.Event()
        self._threads: List[threading.Thread] = []

    def repeat(self, name: str, step: Callable[[], None], interval_s: float) -> None:
        def run() -> None:
            while not self._end.wait(interval_s):
                try:
                    step()
                except Exception as error:  # noqa: BLE001  # told at the end
                    self.failures.append(f"{name}: {type(error).__name__}: {error}")
                    return
                self.counts[name] = self.counts.get(name, 0) + 1

        self._threads.append(threading.Thread(target=run, name=name, daemon=True))
        self._threads[-1].start()

    def end(self) -> None:
        self._end.set()
        for thread in self._threads:
            thread.join(30.0)


def soak(minutes: float, directory: Path) -> List[Sample]:
    """Runs the load and returns the samples. Raises AssertionError for what goes wrong."""
    work = Work()
    with contextlib.ExitStack() as stack:
        master = stack.enter_context(RosMaster(directory))
        bridge = stack.enter_context(Bridge(master, {"unregister_timeout": 1.0, "stall_timeout": 60.0}, rosapi=True))
        stack.enter_context(sensors(master, image_bytes=100_000, image_rate=15.0, map_bytes=1_000_000))
        stack.enter_context(serve(master, "/soak/add", ADD))
        link = stack.enter_context(Link(bridge.port, rate=300_000))
        state, grid = subscription("/state"), subscription("/map", "cbor-raw")
        image = subscription("/image", "cbor-raw")
        fragments = subscription("/image", fragment_size=20_000)
        viewers = [
            Viewer(master, bridge.port, [image, state, grid], connections=3),
            Viewer(master, bridge.port, [fragments, state]),
            Viewer(master, link.port, [image, state]),
        ]
        sleepy = Viewer(master, bridge.port, [image, state, grid])
        for viewer in [*viewers, sleepy]:
            stack.enter_context(viewer)
            viewer.sees("/image", "/state")
        # Encodings that the viewers don't read: what they are sent is thrown away.
        drains = [stack.enter_context(bridge.connect(timeout=30.0)) for _ in range(3)]
        for client, encoding in zip(drains, ("none", "cbor", "png")):
            client.subscribe("/image", throttle_rate=500, compression=encoding)
            client.subscribe("/state", compression=encoding)
        stack.callback(work.end)

        def drain() -> None:
            for client in drains:
                client.collect(0.2)
                client.frames.clear()

        publisher, caller, provider = (stack.enter_context(bridge.connect(timeout=30.0)) for _ in range(3))
        publisher.advertise("/soak/out", INT32)
        listener = stack.enter_context(bridge.connect())
        listener.subscribe("/soak/out", INT32)
        provider.advertise_service("/soak/provided", ADD)
        provider.sync()
        ros_caller = Peer(master)
        stack.callback(ros_caller.node.stop)

        def publish() -> None:
            publisher.publish("/soak/out", {"data": 1})
            listener.next_message("/soak/out")
            listener.frames.clear()

        def call() -> None:
            assert caller.call_service("/soak/add", [1, 2])["values"] == {"sum": 3}
            assert caller.call_service("/rosapi/topics")["result"] is True
            caller.frames.clear()

        def provide() -> None:
            pending = ros_caller.begin_call("/soak/provided", ADD, {"a": 1, "b": 2})
            provider.serve("/soak/provided", lambda args: (True, {"sum": args["a"] + args["b"]}))
            assert pending.result() == {"sum": 3}
            provider.frames.clear()

        def nap() -> None:
            sleepy.stop()
            time.sleep(SLEEP_S)
            sleepy.resume()

        def churn() -> None:
            operations: List[List[Any]] = [
                [
                    {"op": "subscribe", "topic": "/image", "compression": "cbor"},
                    {"op": "subscribe", "topic": f"/soak/in_{number}", "type": INT32},
                    {"op": "advertise", "topic": f"/soak/out_{number}", "type": INT32},
                    {"op": "advertise_service", "service": f"/soak/service_{number}", "type": ADD},
                    {"op": "call_service", "service": "/soak/add", "args": [1, 2]},
                    {"op": "fragment", "id": "never", "num": 0, "total": 2, "data": "x" * 1000},
                ]
                for number in range(5)
            ]
            options = {"port": bridge.port, "seconds": 0, "count": 20, "operations": operations}
            environment = {"PYTHONPATH": f"{_PROGRAMS.parent}:{master.environment.get('PYTHONPATH', '')}"}
            command = [python(), str(_PROGRAMS / "storm.py"), json.dumps(options)]
            with master.process_in(command, "storm", environment) as storm:
                assert storm.wait(60.0) == 0, storm.output

        for name, step, interval_s in (
            ("drain", drain, 0.0),
            ("publish", publish, 0.02),
            ("call", call, 0.1),
            ("provide", provide, 0.2),
            ("nap", nap, AWAKE_S),
            ("churn", churn, 2.0),
        ):
            work.repeat(name, step, interval_s)
        samples = watch(bridge, minutes, work)
        work.end()
        view = viewers[0].view(time.time() - 5.0)
        assert view.rate("/state") > 40, f"/state comes {view.rate('/state'):.1f} times a second in the end"
        assert work.failures == []
        assert bridge.unexpected() == []
        print("did:", ", ".join(f"{name} {count} times" for name, count in sorted(work.counts.items())))
    return samples


def watch(bridge: Bridge, minutes: float, work: Work) -> List[Sample]:
    """A sample every second; returns early when something fails."""
    samples: List[Sample] = []
    begin = last = time.monotonic()
    cpu_s = usage(bridge.process.pid).cpu_s
    while last - begin < 60 * minutes and not work.failures:
        time.sleep(SAMPLE_INTERVAL_S)
        now, found = time.monotonic(), usage(bridge.process.pid)
        share = 100 * (found.cpu_s - cpu_s) / (now - last)
        samples.append(Sample((now - begin) / 60, found.rss_mib, share, found.open_files, found.threads))
        last, cpu_s = now, found.cpu_s
    return samples


def plot(samples: List[Sample], path: Path) -> None:
    """Memory and processor time over the minutes, as a PNG."""
    import matplotlib  # only this script needs it

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (memory, processor, files) = pyplot.subplots(3, sharex=True, figsize=(9, 7), constrained_layout=True)
    minutes = [sample.minute for sample in samples]
    memory.plot(minutes, [sample.rss_mib for sample in samples])
    memory.set_ylabel("RSS, MiB")
    memory.set_ylim(0, 1.2 * max(sample.rss_mib for sample in samples))
    processor.plot(minutes, [sample.cpu_percent for sample in samples], linewidth=0.6)
    processor.set_ylabel("CPU, % of one")
    processor.set_ylim(bottom=0)
    files.plot(minutes, [sample.open_files for sample in samples], label="open files")
    files.plot(minutes, [sample.threads for sample in samples], label="threads")
    files.set_ylim(bottom=0)
    files.legend(loc="lower right")
    files.set_xlabel("minutes")
    figure.suptitle("rosbridge_websocket under a mixed load")
    figure.savefig(str(path), dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("minutes", type=float, nargs="?", default=60.0)
    parser.add_argument("--plot", type=Path, default=Path("soak.png"), help="where the plot goes")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak") as directory:
        samples = soak(arguments.minutes, Path(directory))
    plot(samples, arguments.plot)
    third = len(samples) // 3
    middle, last = (
        statistics.median(sample.rss_mib for sample in part)
        for part in (samples[third : 2 * third], samples[2 * third :])
    )
    cpu = statistics.mean(sample.cpu_percent for sample in samples)
    print(
        f"{len(samples)} samples: RSS {middle:.1f} MiB in the middle third, {last:.1f} MiB in the last; CPU {cpu:.0f} %"
    )
    print(f"plotted in {arguments.plot}")
    if last > middle + FLAT_MIB:
        print("the memory is not flat", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
