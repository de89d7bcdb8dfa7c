# SPDX-License-Identifier: BSD-3-Clause
"""The benchmark works, with every kind of server, and says what it should. Never how fast anything is."""

from __future__ import annotations

import base64
import io
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Dict, List, Optional

import cbor2
import pytest

from support.bridge import Bridge
from support.ros import RosMaster

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import report  # noqa: E402
from benchmarks.cases import all_cases, matching, usual_cases  # noqa: E402
from benchmarks.messages import LOADS, Template, message_class  # noqa: E402
from benchmarks.stamps import HEAD_BYTES, NO_STAMP, finder  # noqa: E402
from benchmarks.tally import Tally, Window, percentile_ms  # noqa: E402
from benchmarks.websocket import Closed, Connection, MessageCounter  # noqa: E402

STAMP_NS = 1_700_000_000_000_000_007
DELIVERY = ("messages_per_s", "megabytes_per_s", "loss", "latency_median_ms", "latency_p99_ms", "sent", "message_bytes")
USAGE = ("cpu_percent", "rss_mb", "other_cpu_percent")
FIELDS: Dict[str, Any] = {
    "topic": (*DELIVERY, *USAGE),
    "publish": (*DELIVERY, *USAGE),
    "service": ("messages_per_s", "latency_median_ms", "latency_p99_ms", *USAGE),
    "idle": ("cpu_percent", "rss_mb", "rss_kb_per_client"),
    "startup": ("startup_s", "rss_mb"),
    "codec": ("cpu_us_per_message", "times_faster"),
}


def bench(master: RosMaster, path: Path, *arguments: str) -> List[Dict[str, Any]]:
    """Runs the benchmark, which makes a master of its own; its results."""
    environment = dict(master.environment)
    paths = [str(ROOT), str(ROOT / "test"), environment.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    command = [sys.executable, "-m", "benchmarks", "--quick", "--json", str(path), *arguments]
    run = subprocess.run(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=120)
    assert run.returncode == 0, run.stdout.decode()
    return report.load(path)


def assert_measured(results: List[Dict[str, Any]]) -> None:
    """Every result has the fields of its kind, with figures."""
    for result in results:
        assert "skipped" not in result, result
        assert "error" not in result, result
        for field in FIELDS[result["kind"]]:
            assert isinstance(result.get(field), (int, float)), (field, result)
            assert math.isfinite(result[field]), (field, result)
        assert result.get("messages_per_s", 1) > 0
        assert result.get("latency_median_ms", 1) > 0


def test_quick_run(ros_master: RosMaster, tmp_path: Path):
    results = bench(ros_master, tmp_path / "a.json")
    not_spoken = [result for result in results if "skipped" in result]
    assert all(result["encoding"] == "foxglove" for result in not_spoken)
    assert_measured([result for result in results if "skipped" not in result])
    assert {result["kind"] for result in results} == set(FIELDS)
    table = report.table(results)
    assert "CPU us/msg" in table
    assert "twist2000/json/1" in table


def test_baseline_beside_ours(ros_master: RosMaster, tmp_path: Path):
    path = tmp_path / "both.json"
    only = ["--only", "twist2000/json/1", "--only", "service/json/1"]
    results = bench(ros_master, path, "--server", "ours", "--server", "baseline", *only)
    assert_measured(results)
    assert [(result["case"], result["server"]) for result in results] == [
        (case, server) for case in ("twist2000/json/1", "service/json/1") for server in ("ours", "baseline")
    ]
    assert "ours" in report.ratios(results).splitlines()[0]


def test_foxglove_server_that_a_command_starts(ros_master: RosMaster, tmp_path: Path):
    command = f"tiny={sys.executable} {ROOT / 'test' / 'foxglove_server.py'} {{port}}"
    results = bench(ros_master, tmp_path / "f.json", "--server", command, "--only", "*/foxglove/*", "--only", "scan/*")
    spoken = [result for result in results if result["encoding"] == "foxglove"]
    assert {result["kind"] for result in spoken} == {"topic", "publish", "service"}
    assert_measured(spoken)
    assert all("skipped" in result for result in results if result["encoding"] != "foxglove")


def test_server_that_runs_already(ros_master: RosMaster, bridge: Bridge, tmp_path: Path):
    there = ["--url", bridge.url, "--master", ros_master.uri, "--only", "twist2000/json/*"]
    results = bench(ros_master, tmp_path / "url.json", *there, "--pid", str(bridge.process.pid), "--name", "this")
    assert_measured(results)
    assert results[0]["server"] == "this"
    unknown = bench(ros_master, tmp_path / "url.json", *there)[0]
    assert unknown["messages_per_s"] > 0
    assert "cpu_percent" not in unknown


def test_case_names_choose():
    cases = all_cases()
    assert len({case.name for case in cases}) == len(cases)
    assert set(usual_cases()) < set(cases)
    assert [case.name for case in matching(cases, ["image/cbor-raw/1*"])] == [
        f"image/cbor-raw/{clients}" for clients in (1, 10, 100)
    ]


@pytest.mark.parametrize("name", sorted(LOADS))
def test_stamped_template_is_the_message(name: str):
    template = Template(LOADS[name])
    template.stamp(41, STAMP_NS)
    message = message_class(LOADS[name].type)().deserialize(bytes(template.body))
    if LOADS[name].type == "std_msgs/String":
        assert message.data.startswith("stamp 1700000000.000000007 ")
        return
    header = message.header if hasattr(message, "header") else getattr(message, message.__slots__[0])[0].header
    assert (header.stamp.to_nsec(), header.seq) == (STAMP_NS, 41)


def encoded(name: str, encoding: str) -> bytes:
    """A message of a load as servers send it, by the libraries rather than by ours."""
    from benchmarks.baseline import to_values

    template = Template(LOADS[name])
    template.stamp(3, STAMP_NS)
    wire = bytes(template.body)
    if encoding == "foxglove":
        return b"\x01" + (1).to_bytes(4, "little") + (5).to_bytes(8, "little") + wire
    if encoding == "cbor-raw":
        return cbor2.dumps({"op": "publish", "topic": "/a", "msg": {"secs": 9, "nsecs": 9, "bytes": wire}})
    message = message_class(LOADS[name].type)().deserialize(wire)
    if encoding == "cbor":
        return cbor2.dumps({"op": "publish", "topic": "/a", "msg": to_values(message, bytes)})
    values = to_values(message, lambda data: base64.b64encode(data).decode())
    return json.dumps({"op": "publish", "topic": "/a", "msg": values}).encode()


@pytest.mark.parametrize("encoding", ["json", "cbor", "cbor-raw", "foxglove"])
@pytest.mark.parametrize("name", sorted(LOADS))
def test_stamp_is_found_in_the_raw_frame(name: str, encoding: str):
    data = bytearray(b"before" + encoded(name, encoding))
    find = finder(name, encoding)
    assert find(data, 6, min(len(data), 6 + HEAD_BYTES)) == STAMP_NS
    status = bytearray(b'{"op":"status","level":"warning","msg":"none"}')
    assert find(status, 0, len(status)) is None


def test_png_counts_without_a_stamp():
    data = bytearray(b'{"op":"png","data":"iVBORw0KGgo"}')
    assert finder("scan", "png")(data, 0, len(data)) == NO_STAMP


def test_tally_separates_what_arrives_from_what_was_sent_in_the_window():
    tally = Tally()
    tally.window = Window(100, 200)
    for stamp, now in ((50, 120), (150, 160), (190, 250), (210, 260)):
        tally.add(stamp, 10, now)
    assert tally.arrived == 2
    assert tally.arrived_bytes == 20
    assert tally.stamped == 2
    assert list(tally.latencies_ns) == [10, 60]


def test_percentiles_are_nearest_ranks():
    values = [number * 1_000_000 for number in range(1, 201)]
    assert percentile_ms(values, 50) == 100.0
    assert percentile_ms(values, 99) == 198.0
    assert percentile_ms([], 50) is None


class _Pieces:
    """Stands for a connection whose bytes arrive in pieces of one size."""

    def __init__(self, data: bytes, piece: int) -> None:
        self.socket = self
        self.rest = b""
        self.sent: List[bytes] = []
        self._data = io.BytesIO(data)
        self._piece = piece

    def recv_into(self, view: memoryview) -> int:
        data = self._data.read(min(self._piece, len(view)))
        view[: len(data)] = data
        return len(data)

    def send(self, payload: bytes, opcode: int) -> None:
        self.sent.append(payload)


def server_frame(payload: bytes, opcode: int = 1, final: bool = True) -> bytes:
    size = len(payload)
    if size < 126:
        length = bytes([size])
    else:
        length = b"\x7e" + size.to_bytes(2, "big") if size < 65536 else b"\x7f" + size.to_bytes(8, "big")
    return bytes([opcode | (0x80 if final else 0)]) + length + payload


@pytest.mark.parametrize("piece", [1, 7, 4096, 1 << 20])
def test_counter_finds_messages_however_they_are_cut(piece: int):
    small, large = encoded("twist2000", "json"), encoded("jpeg", "json")
    data = server_frame(small) + server_frame(b"ping", 9) + server_frame(b'{"op":"status"}') + server_frame(large)
    data += server_frame(small[:200], final=False) + server_frame(b"", 10) + server_frame(small[200:], 0)
    connection: Any = _Pieces(data, piece)
    tally = Tally()
    tally.window = Window(0, 1 << 62)
    counter = MessageCounter(connection, finder("twist2000", "json"), tally)
    for _ in range(math.ceil(len(data) / piece)):
        counter.read()
    with pytest.raises(Closed):
        counter.read()
    assert counter.count == 3
    assert tally.arrived_bytes == 2 * len(small) + len(large)
    assert connection.sent == [b"ping"]
    assert len(tally.latencies_ns) == 3


def results_file(path: Path, server: str, cpu_us: float, encoding: Optional[str] = None) -> Path:
    result = {"server": server, "case": f"scan/{encoding or 'json'}/1", "kind": "topic", "cpu_us_per_message": cpu_us}
    report.save(path, {"results": [result]})
    return path


def test_compare_prints_ratios(tmp_path: Path):
    before, after = results_file(tmp_path / "a", "ours", 80.0), results_file(tmp_path / "b", "ours", 20.0)
    assert report.compare(before, after).splitlines()[1].split()[-3:] == ["80.0", "20.0", "0.25"]
    other = results_file(tmp_path / "c", "cpp", 160.0)
    assert report.compare(before, other).splitlines()[1].split()[-1] == "2.00"
    elsewhere = results_file(tmp_path / "d", "ours", 1.0, "cbor")
    assert "no figures of the same case" in report.compare(before, elsewhere)


def test_compare_refuses_other_files(tmp_path: Path):
    (tmp_path / "x").write_text("[]")
    with pytest.raises(ValueError, match="no results"):
        report.load(tmp_path / "x")


def test_a_connection_waits_for_whole_messages(bridge: Bridge):
    connection = Connection(bridge.url)
    try:
        connection.send(b'{"op":"nonsense","id":"1"}')
        begin = time.monotonic()
        opcode, payload = connection.receive()
        assert time.monotonic() - begin < 10
        assert opcode == 1
        assert json.loads(payload)["op"] == "status"
    finally:
        connection.close()
