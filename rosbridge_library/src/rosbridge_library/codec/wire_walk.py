# SPDX-License-Identifier: BSD-3-Clause
"""Generating code that walks serialized messages: what the compilers of all outgoing encodings share.

Fields of fixed size that follow each other, across nested messages, make one run: a single call of
`Struct.unpack_from` reads them all, and the length prefix of the string or array behind them too. Positions are
a variable plus an offset known when the code is generated.

Generated code checks little, and loses nothing by it: slices and buffers end where the wire bytes end, every other
read behind that raises, and the last thing checked is that the message ended there as well. Only a count that a
loop is to follow is checked first, so that a corrupt one costs nothing.
"""

from __future__ import annotations

import struct
from contextlib import contextmanager
from typing import Any, Iterator, List, Tuple, Union

from ..internal.exceptions import WireError
from .definition import CODE_SIZES, NUMBER_CODES, TIME_CODES, Field, Plan
from .source import Source

# Elements that take no bytes on the wire: its length does not bound how many there may be. A few may always be, however
# many empty messages each is made of; else all of them together are at most so many.
FEW_ELEMENTS = 16
MAX_EMPTY_MESSAGES = 4096

# Remembered arrays are at most so long on the wire.
MAX_REMEMBERED_BYTES = 4096


class Memory:
    """What an array of a message was on the wire the last time, and what was made of it.

    Arrays of names and of layouts (the joints of a robot, the fields of a point cloud) are the same in message after
    message. An entry is replaced as a whole, so that threads need no lock.
    """

    def __init__(self, made: Any) -> None:
        self.entry: Tuple[int, bytes, Any] = (0, b"", made)  # number of elements, their wire bytes

    def keep(self, count: int, raw: Union[bytes, memoryview], made: Any) -> None:
        if len(raw) <= MAX_REMEMBERED_BYTES:
            self.entry = (count, bytes(raw), made)


def max_empty_elements(field: Field) -> int:
    """How many elements that take no bytes on the wire an array may count."""
    each = 1 + (field.message.values if field.message is not None else 0)
    return max(FEW_ELEMENTS, MAX_EMPTY_MESSAGES // each)


def is_memorable(field: Field) -> bool:
    """Whether a field is an array of variable length, whose elements have strings but nothing that is measured."""
    return field.is_array and field.length is None and _has_strings(field) and not _is_measured(field)


def _has_strings(field: Field) -> bool:
    return field.type == "string" or (field.message is not None and any(map(_has_strings, field.message.fields)))


def _is_measured(field: Field) -> bool:
    if field.message is not None:
        return any(map(_is_measured, field.message.fields))
    return field.type in TIME_CODES or field.type in ("float32", "float64")


def corrupt(name: str, wire: bytes, reason: object) -> WireError:
    """The error that generated code raises for bytes which are no message of its type."""
    return WireError(f"{len(wire)} bytes are not a {name} message: {reason}")


def joined_codes(codes: List[str]) -> str:
    """A struct format for codes in a row: ["I", "I", "d"] → "2Id"."""
    groups: List[Tuple[str, int]] = []
    for code in codes:
        if groups and groups[-1][0] == code and len(code) == 1:
            groups[-1] = (code, groups[-1][1] + 1)
        else:
            groups.append((code, 1))
    return "".join(code if count == 1 else f"{count}{code}" for code, count in groups)


class WireWalk:
    """The reading side of a function under generation, which has the wire bytes in `wire`, their number in `end`."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.depth = 0  # of loops
        self.run: List[Tuple[str, str]] = []  # (struct code, variable or "") that the next unpack reads
        self._base = ""  # variable holding a position; "" is 0
        self._run_start = 0  # offset of the run behind the base
        self._offset = 0  # offset of what follows the run

    @property
    def position(self) -> str:
        """Expression for the position of what is read next."""
        if not self._base:
            return str(self._offset)
        return f"{self._base} + {self._offset}" if self._offset else self._base

    def fixed(self, code: str, size: int) -> str:
        """Read an item of a struct code: the variable that has it after the next flush."""
        name = self.source.fresh("v")
        self.run.append((code, name))
        self._offset += size
        return name

    def skip(self, size: int) -> str:
        """Make the run include bytes that are read otherwise: the position where they start."""
        where = self.position
        self.run.append((f"{size}x", ""))
        self._offset += size
        return where

    def count(self) -> str:
        """Read a length prefix, and all that is before it."""
        name = self.fixed("I", 4)
        self.flush()
        return name

    def take(self, size: str) -> str:
        """Pass over `size` bytes (an expression): the slice of the wire that they are."""
        start = self.position
        self._rebase(f"{start} + {size}" if start != "0" else size)
        return f"{start}:{self._base}"

    def flush(self) -> None:
        """Emit the unpack call of the run."""
        names = [name for _, name in self.run if name]
        if self.run:
            unpack = self._unpacker("unpack_from", [code for code, _ in self.run])
            start = self._run_start
            where = f"{self._base} + {start}" if start and self._base else self._base or str(start)
            call = f"{unpack}(wire)" if where == "0" else f"{unpack}(wire, {where})"
            self.source.line("{} = {}".format(", ".join(names) + ",", call) if names else call)
        self.run = []
        self._run_start = self._offset

    def names_of_run(self) -> str:
        """The run as the target of a loop over the elements of an array, instead of an unpack call."""
        names = [name for _, name in self.run]
        self.run = []
        return ", ".join(names) + ","

    def _unpacker(self, method: str, codes: List[str]) -> str:
        layout = "<" + joined_codes(codes)
        return self.source.constant("U", (method, layout), getattr(struct.Struct(layout), method))

    def _rebase(self, expression: str) -> None:
        self.flush()
        base = self.source.fresh("o")
        self.source.line(f"{base} = {expression}")
        self._base, self._run_start, self._offset = base, 0, 0

    @contextmanager
    def elements(self, field: Field, count: str) -> Iterator[None]:
        """A loop over the elements of an array; what is generated inside reads one."""
        self.check_count(field, count)
        self._rebase(self.position)
        at = self._base
        with self.source.block(f"for _ in range({count}):"):
            self.depth += 1
            yield
            self.flush()
            self.source.line(f"{at} = {self.position}")
            self.depth -= 1
        self._base, self._run_start, self._offset = at, 0, 0

    def finish(self) -> None:
        """Read what is left of the run, and make sure that the message ends where the bytes do."""
        self.flush()
        with self.source.block(f"if {self.position} != end:"):
            self.source.line(f'raise ValueError("its fields take %d" % ({self.position}))')

    @contextmanager
    def remembered(self, count: str, made: str, empty: Any) -> Iterator[None]:
        """An array that is made anew, by what is generated inside, only when it is not the one of the last message.

        `made` is the variable that has what is made of it, `empty` what is made of no elements.
        """
        memory = self.source.fresh("memory")
        self.source.use(**{memory: Memory(empty)})
        known, raw, after = self.source.fresh("n"), self.source.fresh("raw"), self.source.fresh("o")
        start = self.position
        self.source.line(f"{known}, {raw}, {made} = {memory}.entry")
        self.source.line(f"{after} = {start} + len({raw})")
        with self.source.block(f"if {count} != {known} or wire[{start}:{after}] != {raw}:"):
            yield
            self.flush()
            self.source.line(f"{after} = {self.position}")
            with self.source.block(f"if {after} <= end:"):
                self.source.line(f"{memory}.keep({count}, wire[{start}:{after}], {made})")
        self._base, self._run_start, self._offset = after, 0, 0

    def check_count(self, field: Field, count: str) -> None:
        """Make sure, before a loop, that so many elements can be there."""
        if field.length is not None:
            return
        size = field.min_element_size
        room = f"(end - ({self.position})) // {size}" if size else str(max_empty_elements(field))
        with self.source.block(f"if {count} > {room}:"):
            self.source.line(f'raise ValueError("{field.name} counts %d elements" % {count})')

    @contextmanager
    def row(self) -> Iterator[None]:
        """What is generated inside reads one element of an array of fixed-size elements, as a run of its own."""
        saved = self._base, self._run_start, self._offset
        self._base, self._run_start, self._offset = "row", 0, 0
        yield
        self._base, self._run_start, self._offset = saved

    def row_reader(self) -> str:
        """`iter_unpack` for the run that was gathered inside `row`."""
        return self._unpacker("iter_unpack", [code for code, _ in self.run])


@contextmanager
def walk_function(source: Source, plan: Plan) -> Iterator[None]:
    """The generated function `convert(wire)`, with what it raises turned into WireError."""
    source.use(NAME=plan.name, corrupt=corrupt, StructError=struct.error)
    with source.block("def convert(wire):"):
        with source.block("try:"):
            source.line("end = len(wire)")
            yield
        with source.block("except (StructError, ValueError, OverflowError) as error:"):
            source.line("raise corrupt(NAME, wire, error) from error")


def number_size(code: str) -> int:
    return CODE_SIZES[code]


def element_code(field: Field) -> str:
    """Struct code of a number, or of each half of a time or duration."""
    return NUMBER_CODES.get(field.type) or TIME_CODES[field.type]
