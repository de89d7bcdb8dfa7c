# SPDX-License-Identifier: BSD-3-Clause
"""The order of one client's operations, and what holds a client back that sends more than is handled."""

from __future__ import annotations

import asyncio
import json
from types import SimpleNamespace
from typing import Any, Awaitable, Callable, List

from rosbridge_library.protocol import MAX_WAITING_OPERATIONS, Protocol


def run(check: Callable[[Protocol], Awaitable[None]]) -> None:
    async def main() -> None:
        node: Any = SimpleNamespace(loop=asyncio.get_running_loop())
        protocol = Protocol("client", node=node)
        await asyncio.wait_for(check(protocol), 10.0)
        protocol.finish()

    asyncio.run(main())


def test_operations_are_handled_in_order_also_while_one_waits() -> None:
    async def check(protocol: Protocol) -> None:
        handled: List[int] = []
        gate, last = asyncio.Event(), asyncio.Event()

        async def slow(message: Any) -> None:
            await gate.wait()
            handled.append(message["number"])

        def quick(message: Any) -> None:
            handled.append(message["number"])
            if message["number"] == 5:
                last.set()

        protocol.register_operation("slow", slow)
        protocol.register_operation("quick", quick)
        for number, op in enumerate(("quick", "slow", "quick", "slow", "quick", "quick")):
            protocol.incoming(json.dumps({"op": op, "number": number}))
        assert handled == [0]
        gate.set()
        await last.wait()
        assert handled == [0, 1, 2, 3, 4, 5]

    run(check)


def test_a_client_that_sends_too_much_is_held_back() -> None:
    async def check(protocol: Protocol) -> None:
        gate = asyncio.Event()

        async def slow(message: Any) -> None:
            await gate.wait()

        protocol.register_operation("slow", slow)
        operation = json.dumps({"op": "slow"})
        held_back = [protocol.incoming(operation) for _ in range(MAX_WAITING_OPERATIONS + 1)]
        assert held_back[:-1] == [None] * MAX_WAITING_OPERATIONS
        assert held_back[-1] is not None
        gate.set()
        await held_back[-1]

    run(check)


def test_holding_back_ends_when_the_client_goes() -> None:
    async def check(protocol: Protocol) -> None:
        async def never(message: Any) -> None:
            await asyncio.Event().wait()

        protocol.register_operation("never", never)
        held_back = None
        while held_back is None:
            held_back = protocol.incoming('{"op": "never"}')
        protocol.finish()
        await held_back

    run(check)
