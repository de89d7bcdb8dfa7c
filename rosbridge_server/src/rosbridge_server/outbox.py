# SPDX-License-Identifier: BSD-3-Clause
"""What waits to be sent to one client, and what of it is dropped when the client is slow.

Two lanes. The control lane (service responses, status, replies, latched messages) goes out in order, first,
and is never dropped. Topic messages wait per source, and sources take turns in fair shares by bytes, so that
a small state topic keeps its rate beside large images. A topic message is encoded when its turn comes, so one
that is dropped never is.

While fewer than ``burst_bytes`` wait nothing is dropped. Above that the source that is furthest behind falls
back to its newest messages (as many as it wants kept), until the client has caught up; then the next. So a
topic of large images degrades before the small ones beside it lose anything. What waits in all is bounded by
``max_bytes``. The transport is handed at most one batch at a time, and none while it still holds unsent
bytes: what is queued here can still be dropped or overtaken, what is in the transport can't.

A client that takes nothing at all for ``stall_timeout`` while the transport holds bytes for it is given up. What
is dropped is counted, and told through `on_dropped` at most once a second.

When nothing waits, a message is encoded and written at once. Nothing here blocks, and nothing is a task.
"""

from __future__ import annotations

import logging
from collections import deque
from typing import Callable, Deque, Dict, List, Mapping, Optional, Protocol, Tuple

from rosbridge_library.payload import Buffer, Payload, Source

logger = logging.getLogger("rosbridge.outbox")

_QUANTUM_BYTES = 16384
"""What a source may send in one turn, on average."""
_BATCH_BYTES = 32768
_BATCH_BUFFERS = 256
"""A write to the transport is closed when it holds this much: so it never has more than one large message."""
_TELL_INTERVAL_S = 1.0
_STALL_CHECKS = 4
"""How often within ``stall_timeout`` it is looked whether a client takes anything."""


class Timer(Protocol):
    def cancel(self) -> None: ...


class Transport(Protocol):
    """The connection that an outbox writes to."""

    def frame(self, payload: Payload) -> Tuple[Buffer, ...]:
        """The buffers that carry ``payload``."""
        ...

    def write(self, buffers: List[Buffer]) -> bool:
        """Sends ``buffers``. False when some bytes are still unsent: then the outbox's `drained` is called
        later."""
        ...

    @property
    def taken_bytes(self) -> int:
        """How many of the bytes that were written the connection has taken."""
        ...

    def give_up(self, reason: str) -> None:
        """The client does not read, as ``reason`` tells: the connection is to be closed (soon, not within this
        call)."""
        ...


class _Lane:
    """What waits for one source: payloads of the message whose turn has come, then messages not encoded
    yet."""

    __slots__ = ("begun", "bytes", "credit", "extra", "in_turn", "keep", "newest_only", "source", "waiting")

    def __init__(self, source: Source) -> None:
        self.source = source
        self.begun: Deque[Payload] = deque()
        self.waiting: Deque[Tuple[object, int]] = deque()
        self.bytes = 0
        """Of the messages that wait unencoded."""
        self.credit = 0
        """Bytes it may send in this turn; negative after a message larger than that, to be made up for while
        others wait (when alone, there is nobody to make it up to)."""
        self.in_turn = False
        self.keep = max(source.keep, 1)
        self.extra = 0
        """Bytes of the waiting messages that are not among the newest ``keep``."""
        self.newest_only = False
        """Drops the extra messages, until the client has caught up."""

    def append(self, message: object, size: int) -> None:
        self.waiting.append((message, size))
        self.bytes += size
        keep = max(self.source.keep, 1)
        if keep != self.keep:
            self.keep = keep
            self.extra = sum(size for _, size in list(self.waiting)[:-keep])
        elif len(self.waiting) > keep:
            self.extra += self.waiting[-keep - 1][1]

    def pop_oldest(self) -> Tuple[object, int]:
        oldest = self.waiting.popleft()
        self.bytes -= oldest[1]
        if len(self.waiting) >= self.keep:
            self.extra -= oldest[1]
        return oldest


class ClientOutbox:
    """The `rosbridge_library.payload.Outbox` of one connection.

    ``call_later(seconds, function)`` starts a timer (the loop's); ``delay_between_messages`` and ``stall_timeout``
    are in seconds, 0 for none. Counters: ``sent_messages``, ``sent_bytes`` (without framing), and ``dropped``,
    messages by topic. ``on_dropped`` is called with those that were dropped since it was called last.
    """

    def __init__(
        self,
        transport: Transport,
        call_later: Callable[[float, Callable[[], None]], Timer],
        *,
        burst_bytes: int,
        max_bytes: int,
        delay_between_messages: float = 0.0,
        stall_timeout: float = 0.0,
    ) -> None:
        self.on_dropped: Optional[Callable[[Mapping[str, int]], None]] = None
        self.sent_messages = 0
        self.sent_bytes = 0
        self.dropped: Dict[str, int] = {}
        self._transport = transport
        self._call_later = call_later
        self._burst_bytes = burst_bytes
        self._max_bytes = max_bytes
        self._delay = delay_between_messages
        self._stall_timeout = stall_timeout
        self._control: Deque[Payload] = deque()
        self._control_bytes = 0
        self._lanes: Dict[Source, _Lane] = {}
        self._turns: Deque[_Lane] = deque()
        self._topic_bytes = 0
        self._behind: List[_Lane] = []  # the lanes with newest_only
        self._held = False  # the transport has unsent bytes
        self._pacing: Optional[Timer] = None
        self._telling: Optional[Timer] = None
        self._untold: Dict[str, int] = {}
        self._watching: Optional[Timer] = None
        self._taken_bytes = 0  # when it was looked last
        self._idle_checks = 0
        self._writing = False
        self._closed = False

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait here: control messages and begun ones as encoded, others as they were offered."""
        return self._control_bytes + self._topic_bytes

    def send(self, payload: Payload) -> None:
        """See `rosbridge_library.payload.Outbox.send`."""
        if self._closed:
            return
        if self._control_bytes >= self._max_bytes:
            # Neither dropping nor growing is allowed here, and a client that reads would not let it come to
            # this.
            self._give_up(f"{self._control_bytes} bytes of responses wait for it")
            return
        self._control.append(payload)
        self._control_bytes += payload.size
        if not self._pump():
            self._shrink()

    def offer(self, source: Source, message: object, size: int) -> None:
        """See `rosbridge_library.payload.Outbox.offer`."""
        if self._closed:
            return
        lane = self._lanes.get(source)
        if lane is None:
            lane = self._lanes[source] = _Lane(source)
        lane.append(message, size)
        self._topic_bytes += size
        if not lane.in_turn:
            lane.in_turn = True
            self._turns.append(lane)
        if not self._pump():
            if lane.newest_only:
                self._keep_newest(lane)
            if self._topic_bytes > self._burst_bytes:
                self._limit_burst()
            self._shrink()

    def forget(self, source: Source) -> None:
        """See `rosbridge_library.payload.Outbox.forget`."""
        lane = self._lanes.pop(source, None)
        if lane is not None:
            self._topic_bytes -= lane.bytes
            lane.waiting.clear()
            lane.bytes = lane.extra = 0

    def drained(self) -> None:
        """The transport has sent all that it held."""
        self._held = False
        self._pump()

    def close(self) -> None:
        """The connection is gone: drops everything, and takes nothing any more."""
        self._closed = True
        for timer in (self._pacing, self._telling, self._watching):
            if timer is not None:
                timer.cancel()
        self._pacing = self._telling = self._watching = None
        self._control.clear()
        self._lanes.clear()
        self._turns.clear()
        self._control_bytes = self._topic_bytes = 0

    # What goes next

    def _pump(self) -> bool:
        """Writes what may be written now; False when that is nothing, since the client or the pace is
        slow."""
        # Encoding a message may come back here with another one (a status, say): the loop below takes it
        # along.
        if self._held or self._writing or self._closed or self._pacing is not None:
            return False
        self._writing = True
        try:
            while not (self._held or self._pacing is not None):
                batch = self._next_batch()
                if not batch or self._closed:
                    break
                self._held = not self._transport.write(batch)
        finally:
            self._writing = False
        if self._held:
            self._watch()
        return True

    def _next_batch(self) -> List[Buffer]:
        batch: List[Buffer] = []
        size = 0
        while size < _BATCH_BYTES and len(batch) < _BATCH_BUFFERS:
            payload = self._next()
            if payload is None:
                break
            batch.extend(self._transport.frame(payload))
            size += payload.size
            self.sent_messages += 1
            self.sent_bytes += payload.size
            if self._delay > 0:
                self._pacing = self._call_later(self._delay, self._pace)
                break
        return batch

    def _pace(self) -> None:
        self._pacing = None
        self._pump()

    def _next(self) -> Optional[Payload]:
        if self._control:
            payload = self._control.popleft()
            self._control_bytes -= payload.size
            return payload
        turns = self._turns
        while turns:
            lane = turns[0]
            if lane.credit <= 0:
                lane.credit = lane.credit + _QUANTUM_BYTES if len(turns) > 1 else _QUANTUM_BYTES
                turns.rotate(-1)
            elif lane.begun:
                payload = lane.begun.popleft()
                lane.credit -= payload.size
                self._topic_bytes -= payload.size
                return payload
            elif lane.waiting:
                self._encode_oldest(lane)
            else:
                turns.popleft()
                lane.in_turn = False
        if self._behind:  # and yet nothing waits: the client has caught up
            for lane in self._behind:
                lane.newest_only = False
            self._behind.clear()
        return None

    def _encode_oldest(self, lane: _Lane) -> None:
        message, size = lane.pop_oldest()
        self._topic_bytes -= size
        try:
            payloads = lane.source.encode(message)
        except Exception:
            logger.exception("A message of %s could not be encoded and is left out", lane.source.topic)
            return
        for payload in payloads:
            lane.begun.append(payload)
            self._topic_bytes += payload.size

    # What is dropped

    def _limit_burst(self) -> None:
        """Lets the sources that are furthest behind fall back to their newest messages."""
        while sum(lane.extra for lane in self._lanes.values()) > self._burst_bytes:
            lane = max(self._lanes.values(), key=lambda lane: lane.extra)
            lane.newest_only = True
            self._behind.append(lane)
            self._keep_newest(lane)

    def _keep_newest(self, lane: _Lane) -> None:
        while len(lane.waiting) > lane.keep:
            self._drop_oldest(lane)

    def _drop_oldest(self, lane: _Lane) -> None:
        _, size = lane.pop_oldest()
        self._topic_bytes -= size
        topic = lane.source.topic
        self.dropped[topic] = self.dropped.get(topic, 0) + 1
        self._untold[topic] = self._untold.get(topic, 0) + 1
        if self._telling is None and self.on_dropped is not None:
            self._telling = self._call_later(0, self._tell)

    def _shrink(self) -> None:
        """Drops topic messages until ``max_bytes`` hold, from the source that takes most; one alone may be
        larger."""
        while self.waiting_bytes > self._max_bytes and self._lanes:
            lane = max(self._lanes.values(), key=lambda lane: lane.bytes)
            if lane.bytes == 0 or (len(lane.waiting) == 1 and lane.bytes == self.waiting_bytes):
                return
            self._drop_oldest(lane)

    def _tell(self) -> None:
        self._telling = None
        if not self._untold or self.on_dropped is None:
            return
        self._telling = self._call_later(_TELL_INTERVAL_S, self._tell)
        if not self._control:  # else what was told last may wait yet: more of it would not help
            untold, self._untold = self._untold, {}
            self.on_dropped(untold)

    # A client that takes nothing

    def _watch(self) -> None:
        if self._stall_timeout > 0 and self._watching is None and not self._closed:
            self._taken_bytes = self._transport.taken_bytes
            self._idle_checks = 0
            self._watch_on()

    def _watch_on(self) -> None:
        self._watching = self._call_later(self._stall_timeout / _STALL_CHECKS, self._look)

    def _look(self) -> None:
        self._watching = None
        if not self._held:
            return
        taken = self._transport.taken_bytes
        self._idle_checks = self._idle_checks + 1 if taken == self._taken_bytes else 0
        self._taken_bytes = taken
        if self._idle_checks < _STALL_CHECKS:
            self._watch_on()
        else:
            self._give_up(f"it took nothing for {self._stall_timeout:g} s, and {self.waiting_bytes} bytes wait for it")

    def _give_up(self, reason: str) -> None:
        self.close()
        self._transport.give_up(reason)
