# SPDX-License-Identifier: BSD-3-Clause
"""The outbox: order, fair shares, bounds, drops and pacing, against a link whose speed the test decides."""

from __future__ import annotations

import heapq
import itertools
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple

import pytest

from rosbridge_library.payload import Buffer, Payload
from rosbridge_server.outbox import ClientOutbox

MIB = 1 << 20


class Clock:
    """Timers that run when the test lets time pass."""

    def __init__(self) -> None:
        self.now = 0.0
        self._timers: List[Tuple[float, int, Callable[[], None]]] = []
        self._cancelled: Dict[int, bool] = {}
        self._number = itertools.count()

    def call_later(self, seconds: float, function: Callable[[], None]) -> Timer:
        number = next(self._number)
        heapq.heappush(self._timers, (self.now + seconds, number, function))
        return Timer(self, number)

    def advance(self, seconds: float) -> None:
        end = self.now + seconds
        while self._timers and self._timers[0][0] <= end + 1e-9:
            self.now, number, function = heapq.heappop(self._timers)
            if not self._cancelled.get(number):
                function()
        self.now = end

    def cancel(self, number: int) -> None:
        self._cancelled[number] = True

    @property
    def pending(self) -> int:
        return sum(not self._cancelled.get(number) for _, number, _ in self._timers)


class Timer:
    def __init__(self, clock: Clock, number: int) -> None:
        self._clock = clock
        self._number = number

    def cancel(self) -> None:
        self._clock.cancel(self._number)


class Link:
    """A transport that takes `room` bytes at once, and more only when the test says so."""

    def __init__(self, room: float = float("inf")) -> None:
        self.room = room
        self.unsent = 0.0
        self.sent: List[bytes] = []
        self.writes: List[List[bytes]] = []
        self.given_up: List[str] = []
        self.taken_bytes = 0.0
        self.outbox: Optional[ClientOutbox] = None

    def frame(self, payload: Payload) -> Tuple[Buffer, ...]:
        return payload.parts

    def write(self, buffers: List[Buffer]) -> bool:
        assert not self.unsent, "written to while it still held something"
        written = [bytes(buffer) for buffer in buffers]
        self.writes.append(written)
        self.sent += written
        size = sum(map(len, written))
        self.taken_bytes += min(size, self.room)
        if size <= self.room:
            self.room -= size
            return True
        self.unsent, self.room = size - self.room, 0
        return False

    def give_up(self, reason: str) -> None:
        self.given_up.append(reason)

    def carry(self, size: float) -> None:
        """Lets so many bytes go out."""
        assert self.outbox is not None
        while size > 0:
            if self.unsent:
                gone = min(self.unsent, size)
                self.unsent -= gone
                self.taken_bytes += gone
                size -= gone
                if not self.unsent:
                    self.room = 0
                    self.outbox.drained()
            else:
                self.room = size
                return

    def take(self) -> List[bytes]:
        sent, self.sent = self.sent, []
        return sent


class Topic:
    """A source whose messages are bytes; counts what it encodes."""

    def __init__(self, topic: str, keep: int = 1, fragment: int = 0) -> None:
        self.topic = topic
        self.keep = keep
        self.fragment = fragment
        self.encoded: List[bytes] = []

    def encode(self, message: Any) -> Sequence[Payload]:
        self.encoded.append(message)
        step = self.fragment or max(len(message), 1)
        return [Payload([message[i : i + step]]) for i in range(0, max(len(message), 1), step)]


def make(room: float = float("inf"), **options: Any) -> Tuple[ClientOutbox, Link, Clock]:
    link, clock = Link(room), Clock()
    settings: Dict[str, Any] = {"burst_bytes": MIB, "max_bytes": 64 * MIB}
    settings.update(options)
    link.outbox = ClientOutbox(link, clock.call_later, **settings)
    return link.outbox, link, clock


def put(outbox: ClientOutbox, source: Topic, message: bytes) -> None:
    outbox.offer(source, message, len(message))


def send(outbox: ClientOutbox, message: bytes) -> None:
    outbox.send(Payload([message]))


def test_a_fast_client_gets_everything_at_once_and_in_order() -> None:
    outbox, link, _ = make()
    a, b = Topic("/a"), Topic("/b")
    for i in range(3):
        put(outbox, a, b"a%d" % i)
        send(outbox, b"c%d" % i)
        put(outbox, b, b"b%d" % i)
        assert link.take() == [b"a%d" % i, b"c%d" % i, b"b%d" % i]
    assert outbox.waiting_bytes == 0
    assert (outbox.sent_messages, outbox.sent_bytes, outbox.dropped) == (9, 18, {})


def test_nothing_is_dropped_in_a_burst_and_it_goes_out_in_one_write() -> None:
    outbox, link, _ = make(room=0)
    a = Topic("/a")
    put(outbox, a, b"first")  # occupies the link
    for i in range(100):
        put(outbox, a, b"%03d" % i)
    assert a.encoded == [b"first"], "encoded before their turn"
    assert outbox.waiting_bytes == 300
    link.carry(1000)
    assert link.take() == [b"first"] + [b"%03d" % i for i in range(100)]
    assert len(link.writes) == 2
    assert outbox.dropped == {}


def test_above_the_burst_the_source_that_is_furthest_behind_keeps_its_newest() -> None:
    outbox, link, _ = make(room=0, burst_bytes=1000)
    small, large = Topic("/small", keep=1), Topic("/large", keep=3)
    send(outbox, b"-")
    for i in range(20):
        put(outbox, small, b"s%02d" % i)
        put(outbox, large, b"l%02d" % i + b" " * 97)
    assert outbox.dropped == {"/large": 17}
    assert large.encoded == [], "encoded although its turn has not come"
    link.carry(10**6)
    got = [message[:3] for message in link.take()[1:]]
    assert [message for message in got if message[:1] == b"s"] == [b"s%02d" % i for i in range(20)]
    assert [message for message in got if message[:1] == b"l"] == [b"l17", b"l18", b"l19"]
    assert len(large.encoded) == 3, "a dropped message was encoded"


def test_every_source_falls_back_when_all_are_behind() -> None:
    outbox, link, _ = make(room=0, burst_bytes=1000)
    sources = [Topic(f"/{i}", keep=i) for i in range(5)]
    send(outbox, b"-")
    for i in range(500):
        for source in sources:
            put(outbox, source, b"%03d" % i + b" " * 97)
    assert outbox.waiting_bytes <= 1000 + (1 + 1 + 2 + 3 + 4) * 100
    assert set(outbox.dropped) == {source.topic for source in sources}
    link.carry(10**6)
    for source in sources:
        newest = [b"%03d" % i for i in range(500 - max(source.keep, 1), 500)]
        assert [message[:3] for message in source.encoded][-len(newest) :] == newest


def test_a_source_that_fell_back_stays_so_until_the_client_has_caught_up() -> None:
    outbox, link, _ = make(room=0, burst_bytes=1000)
    image = Topic("/image")
    send(outbox, b"-")
    for i in range(20):
        put(outbox, image, b"%02d" % i * 200)
    assert outbox.waiting_bytes == 400
    link.carry(10**6)
    assert [message[:2] for message in link.take()[1:]] == [b"19"]
    link.room = 0
    send(outbox, b"-")
    put(outbox, image, b"20" * 200)
    put(outbox, image, b"21" * 200)
    link.carry(10**6)
    assert [message[:2] for message in link.take()[1:]] == [b"20", b"21"]


def test_a_change_of_keep_counts_at_the_next_message() -> None:
    outbox, link, _ = make(room=0, burst_bytes=100)
    source = Topic("/a", keep=1000)
    send(outbox, b"-")
    for i in range(50):
        put(outbox, source, b"%02d" % i + b" " * 8)
    assert outbox.dropped == {}
    source.keep = 2
    put(outbox, source, b"50")
    assert outbox.dropped == {"/a": 49}
    source.keep = 3
    put(outbox, source, b"51")
    put(outbox, source, b"52")
    link.carry(1000)
    assert [message[:2] for message in link.take()[1:]] == [b"50", b"51", b"52"]


def test_the_newest_message_of_a_source_is_kept_even_when_it_is_larger_than_the_bound() -> None:
    outbox, link, _ = make(room=0, burst_bytes=0, max_bytes=100)
    image = Topic("/image")
    send(outbox, b"-")
    for i in range(5):
        put(outbox, image, b"%d" % i * 500)
    assert outbox.waiting_bytes == 500
    assert outbox.dropped == {"/image": 4}
    link.carry(10000)
    assert link.take()[1:] == [b"4" * 500]


def test_the_bound_holds_whatever_the_queue_lengths_say() -> None:
    outbox, _, _ = make(room=0, max_bytes=10 * MIB)
    greedy, modest = Topic("/greedy", keep=10**6), Topic("/modest", keep=10**6)
    send(outbox, b"-")
    put(outbox, modest, b"m" * 1000)
    for _ in range(200):
        put(outbox, greedy, b"g" * 100_000)
        assert outbox.waiting_bytes <= 10 * MIB
    assert set(outbox.dropped) == {"/greedy"}, "the one who takes most pays"
    for _ in range(90):
        send(outbox, b"r" * 100_000)
        assert outbox.waiting_bytes <= 10 * MIB
    assert outbox.waiting_bytes >= 9_000_000, "a response was dropped"


def test_control_goes_first_in_order_and_is_never_dropped() -> None:
    outbox, link, _ = make(room=0, burst_bytes=0)
    a = Topic("/a", keep=10)
    put(outbox, a, b"under way")
    for i in range(5):
        put(outbox, a, b"a%d" % i)
        send(outbox, b"c%d" % i)
    link.carry(1000)
    assert link.take() == [b"under way"] + [b"c%d" % i for i in range(5)] + [b"a%d" % i for i in range(5)]


def test_control_goes_between_the_fragments_of_a_message() -> None:
    outbox, link, _ = make(room=0)
    big = Topic("/big", fragment=100_000)
    put(outbox, big, b"f" * 500_000)
    link.carry(50_000)
    send(outbox, b"urgent")
    link.carry(10**6)
    assert [len(message) for message in link.take()] == [100_000, 6] + [100_000] * 4


def test_a_client_that_reads_no_responses_is_given_up() -> None:
    outbox, link, _ = make(room=0, max_bytes=1000)
    send(outbox, b"-")
    send(outbox, b"x" * 5000)  # one may be as large as it likes
    assert link.given_up == []
    send(outbox, b"x")
    assert link.given_up == ["5000 bytes of responses wait for it"]
    assert outbox.waiting_bytes == 0
    put(outbox, Topic("/a"), b"x")
    send(outbox, b"x")
    assert outbox.waiting_bytes == 0
    assert len(link.given_up) == 1


def test_at_most_one_large_message_is_with_the_transport() -> None:
    outbox, link, _ = make(room=0)
    image = Topic("/image", keep=10)
    send(outbox, b"-")
    for _ in range(3):
        put(outbox, image, b"i" * 200_000)
        send(outbox, b"s")
    link.carry(10**6)
    sizes = [[len(buffer) for buffer in write] for write in link.writes]
    assert sizes == [[1], [1, 1, 1, 200_000], [200_000], [200_000]]


@pytest.mark.parametrize("image_bytes", [10_000, 250_000, 900_000, 3_000_000])
def test_a_state_topic_keeps_its_rate_beside_images_on_a_slow_link(image_bytes: int) -> None:
    """1 MB/s, 60 images/s of any size, 50 Hz state: each state message is out before the image after next."""
    outbox, link, clock = make(room=0)
    state, image = Topic("/state"), Topic("/image")
    seconds = 20
    delays: List[float] = []
    images = offered = 0
    step = 0.001
    for tick in range(int(seconds / step)):
        if tick % 20 == 0:
            put(outbox, state, b"%8.3f" % clock.now + b"." * 200)
        if tick % 16 == 0:
            put(outbox, image, b"i" * image_bytes)
            offered += image_bytes
        link.carry(1_000_000 * step)
        for message in link.take():
            if message[:1] == b"i":
                images += 1
            else:
                delays.append(clock.now - float(message[:8]))
        clock.advance(step)
    assert "/state" not in outbox.dropped
    assert len(delays) >= 50 * (seconds - 2 * image_bytes / 1e6 - 0.1)
    assert max(delays) < 2 * image_bytes / 1e6 + 0.1
    assert images * image_bytes > 0.9 * min(offered, 1_000_000 * seconds), "the rest of the link is the images'"
    assert outbox.waiting_bytes < 2 * MIB + image_bytes


def test_sources_share_by_bytes_and_not_by_messages() -> None:
    outbox, link, _ = make(room=0)
    small, large = Topic("/small", keep=1000), Topic("/large")
    sent = {b"s": 0, b"l": 0}
    for _ in range(3000):
        for _ in range(10):  # both always have something waiting
            put(outbox, small, b"s" * 1_000)
        put(outbox, large, b"l" * 300_000)
        link.carry(5_000)
        for message in link.take():
            sent[message[:1]] += len(message)
    assert outbox.dropped["/small"] > 1000
    assert outbox.dropped["/large"] > 1000
    assert 0.4 < sent[b"s"] / (sent[b"l"] + sent[b"s"]) < 0.6


def test_a_source_that_was_alone_owes_nothing_when_others_come() -> None:
    outbox, link, _ = make(room=0)
    long_alone, late = Topic("/alone", keep=1000), Topic("/late", keep=1000)
    for _ in range(100):
        put(outbox, long_alone, b"a" * 100_000)
        link.carry(100_000)
    link.take()
    for _ in range(5):
        put(outbox, long_alone, b"a" * 100_000)
        put(outbox, late, b"l" * 100_000)
    link.carry(600_000)
    order = b"".join(message[:1] for message in link.take())
    assert order.count(b"a") >= 2, f"starved: {order!r}"
    assert order.count(b"l") >= 2, f"starved: {order!r}"


def test_forget_drops_what_waits_and_finishes_what_has_begun() -> None:
    outbox, link, _ = make(room=0)
    whole, parts, other = Topic("/whole"), Topic("/parts", fragment=100_000), Topic("/other")
    put(outbox, parts, b"p" * 300_000)
    put(outbox, whole, b"w")
    put(outbox, parts, b"q" * 300_000)
    put(outbox, other, b"o")
    outbox.forget(whole)
    outbox.forget(parts)
    outbox.forget(parts)
    link.carry(10**6)
    got = link.take()
    assert [message[:1] for message in got if len(message) > 1] == [b"p"] * 3
    assert [message for message in got if len(message) == 1] == [b"o"]
    assert outbox.waiting_bytes == 0
    assert whole.encoded == []
    put(outbox, whole, b"again")
    link.carry(1000)
    assert link.take() == [b"again"]


def test_delay_between_messages_paces_everything_and_blocks_nothing() -> None:
    outbox, link, clock = make(delay_between_messages=0.5)
    parts = Topic("/parts", fragment=2)
    send(outbox, b"c1")
    send(outbox, b"c2")
    put(outbox, parts, b"aabbcc")
    times: List[Tuple[float, bytes]] = []
    for _ in range(40):
        times += [(clock.now, message) for message in link.take()]
        clock.advance(0.1)
    assert [message for _, message in times] == [b"c1", b"c2", b"aa", b"bb", b"cc"]
    assert [time for time, _ in times] == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0])
    assert clock.pending == 0, "a timer runs with nothing to send"
    send(outbox, b"c3")
    assert link.take() == [b"c3"], "the first one after a pause need not wait"


def test_a_client_that_takes_nothing_is_given_up() -> None:
    outbox, link, clock = make(room=0, stall_timeout=8)
    put(outbox, Topic("/a"), b"x" * 500)
    send(outbox, b"y" * 100)
    clock.advance(7.9)
    assert link.given_up == []
    clock.advance(2.2)
    assert link.given_up == ["it took nothing for 8 s, and 100 bytes wait for it"]
    assert clock.pending == 0
    assert outbox.waiting_bytes == 0
    put(outbox, Topic("/a"), b"x")
    assert len(link.writes) == 1, "written to after the end"


def test_a_client_that_takes_a_little_is_kept() -> None:
    outbox, link, clock = make(room=0, stall_timeout=8)
    put(outbox, Topic("/a"), b"x" * 500)
    for _ in range(100):
        clock.advance(7.9)
        link.carry(1)
    assert link.given_up == []
    assert clock.pending == 1
    link.carry(1000)
    clock.advance(8)
    assert clock.pending == 0, "a timer runs with nothing to send"
    clock.advance(1000)
    assert link.given_up == []


def test_a_client_that_stalls_again_and_again_has_its_time_each_time() -> None:
    outbox, link, clock = make(room=0, stall_timeout=8)
    for _ in range(50):
        put(outbox, Topic("/a"), b"x" * 500)
        clock.advance(7)
        link.carry(500)
    assert link.given_up == []


def test_without_a_stall_timeout_nobody_is_given_up_and_no_timer_runs() -> None:
    outbox, link, clock = make(room=0)
    put(outbox, Topic("/a"), b"x" * 500)
    assert clock.pending == 0
    clock.advance(10**6)
    assert link.given_up == []


def test_what_is_dropped_is_told_at_most_once_a_second_and_all_of_it() -> None:
    outbox, _, clock = make(room=0, burst_bytes=1000)
    told: List[Tuple[float, Dict[str, int]]] = []
    outbox.on_dropped = lambda dropped: told.append((clock.now, dict(dropped)))
    a, b = Topic("/a"), Topic("/b")
    put(outbox, a, b"-")
    for step in range(350):
        clock.advance(0.01)
        put(outbox, a, b"x" * 600)
        if 110 <= step < 150:
            put(outbox, b, b"y" * 600)
    clock.advance(10)
    assert [now for now, _ in told] == pytest.approx([told[0][0] + second for second in range(len(told))])
    assert len(told) in (4, 5)
    assert [sorted(dropped) for _, dropped in told if "/b" in dropped] == [["/a", "/b"]]
    assert {topic: sum(dropped.get(topic, 0) for _, dropped in told) for topic in ("/a", "/b")} == outbox.dropped
    assert clock.pending == 0


def test_drops_are_not_told_to_a_client_that_has_not_taken_what_it_was_told_before() -> None:
    outbox, link, clock = make(room=0, burst_bytes=1000)
    told: List[Dict[str, int]] = []

    def tell(dropped: Any) -> None:
        told.append(dict(dropped))
        send(outbox, b"status")

    outbox.on_dropped = tell
    put(outbox, Topic("/a"), b"-")
    a = Topic("/a")
    for _ in range(1000):
        put(outbox, a, b"x" * 600)
        clock.advance(0.1)
    assert len(told) == 1
    link.carry(10**6)
    clock.advance(1)
    assert len(told) == 2
    assert sum(dropped["/a"] for dropped in told) == outbox.dropped["/a"]


def test_no_timer_outlives_a_closed_outbox() -> None:
    outbox, link, clock = make(delay_between_messages=0.5, stall_timeout=5, burst_bytes=0)
    outbox.on_dropped = lambda dropped: None
    link.room = 1
    put(outbox, Topic("/a"), b"2")
    a = Topic("/a")
    for _ in range(3):
        put(outbox, a, b"3")
    link.take()
    outbox.close()
    assert clock.pending == 0
    outbox, link, clock = make(delay_between_messages=0.5)
    send(outbox, b"1")
    send(outbox, b"2")
    outbox.close()
    assert clock.pending == 0
    outbox.drained()
    clock.advance(1)
    assert link.take() == [b"1"]


def test_encoding_may_send_and_offer_more() -> None:
    outbox, link, _ = make(room=0)

    class Complaining(Topic):
        def encode(self, message: Any) -> Sequence[Payload]:
            send(outbox, b"status")
            put(outbox, quiet, b"quiet")
            return super().encode(message)

    quiet, complaining = Topic("/quiet"), Complaining("/complaining")
    link.carry(1000)
    put(outbox, complaining, b"message")
    assert sorted(link.take()) == [b"message", b"quiet", b"status"]
    assert outbox.waiting_bytes == 0


def test_a_message_that_encodes_to_nothing_is_passed_over() -> None:
    outbox, link, _ = make()

    class Silent(Topic):
        def encode(self, message: Any) -> Sequence[Payload]:
            return []

    put(outbox, Silent("/silent"), b"x")
    put(outbox, Topic("/a"), b"y")
    assert link.take() == [b"y"]
    assert outbox.waiting_bytes == 0


def test_a_bug_in_an_encoder_is_logged_and_costs_that_message_alone(caplog: pytest.LogCaptureFixture) -> None:
    outbox, link, _ = make(room=0)

    class Broken(Topic):
        def encode(self, message: Any) -> Sequence[Payload]:
            raise RuntimeError("no codec")

    put(outbox, Broken("/broken"), b"x")
    put(outbox, Topic("/a"), b"y")
    assert link.take() == [b"y"]
    assert outbox.waiting_bytes == 0
    assert "/broken" in caplog.text
    assert "no codec" in caplog.text


def test_the_bytes_that_wait_are_counted_right_in_every_order() -> None:
    """After any mix of operations, when all is sent the count is back at zero."""
    outbox, link, _ = make(room=0, burst_bytes=5000, max_bytes=20000)
    sources = [Topic(f"/{i}", keep=i, fragment=(i % 3) * 700) for i in range(6)]
    state = 12345
    for _ in range(5000):
        state = (state * 1103515245 + 12345) % (1 << 31)
        source = sources[state % 6]
        choice = (state >> 8) % 10
        if choice < 6:
            put(outbox, source, b"x" * ((state >> 12) % 3000))
        elif choice == 6:
            outbox.forget(source)
        elif choice == 7 and outbox.waiting_bytes < 15000:
            send(outbox, b"c" * 100)
        else:
            link.carry((state >> 12) % 2000)
        assert 0 <= outbox.waiting_bytes <= 20000 + 3000
    assert link.given_up == []
    link.carry(float(10**7))
    assert outbox.waiting_bytes == 0
