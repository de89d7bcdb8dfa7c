# SPDX-License-Identifier: BSD-3-Clause
"""Compiling wire bytes → CBOR.

No Python object is made of a message. A run of fixed-size fields is one unpack and one pack, whose format holds the
keys and type bytes between the numbers as constants. Strings and arrays are slices of the wire under a CBOR head;
numeric arrays stay little-endian, which is what the typed array tags of RFC 8746 are for. Long arrays of
fixed-size messages are tables: a NumPy structured type lays out the CBOR of an element, keys included, and is
filled column by column.

Integers have the width of their field, whatever their value, and float32 is single precision.
"""

from __future__ import annotations

import struct
from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence, Tuple, Union

import numpy as np

from .definition import NUMBER_CODES, NUMPY_TYPES, TIME_CODES, Field, Plan
from .pieces import Pieces
from .source import Source
from .wire_walk import WireWalk, is_memorable, number_size, walk_function

# RFC 8746 tags of little-endian typed arrays; arrays of bool and bytes have none.
ARRAY_TAGS: Mapping[str, int] = {
    "b": 72, "h": 77, "i": 78, "q": 79, "H": 69, "I": 70, "Q": 71, "f": 85, "d": 86
}  # fmt: skip
# Fixed-length arrays of fixed-size elements are written out in the run up to this many numbers.
INLINE_NUMBERS = 24
# An array is a table from so many elements on, when they have no more columns than the second.
TABLE_ROWS = 12
ROW_NUMBERS = 128
# Array slices are copied when the message is smaller than this: a memoryview takes longer to make.
BULK_BYTES = 8192

_TEXT, _BYTES, _ARRAY, _MAP, _TAG = 0x60, 0x40, 0x80, 0xA0, 0xC0
_BOOLS = bytes([0xF4] + [0xF5] * 255)
# Unsigned struct code → additional information of a CBOR integer of that size.
_WIDTHS: Mapping[str, int] = {"B": 24, "H": 25, "I": 26, "Q": 27}


def head(major: int, value: int) -> bytes:
    """The head of a CBOR item, in its shortest form; `major` is the type in the upper three bits."""
    if value < 24:
        return bytes([major | value])
    for code, width in _WIDTHS.items():
        if value < 1 << 8 * number_size(code):
            return struct.pack(">B" + code, major | width, value)
    raise ValueError(f"CBOR has no length of {value}")


class Heads(Dict[int, bytes]):
    """Heads of one major type by their value, made beforehand for small ones."""

    def __init__(self, major: int) -> None:
        super().__init__({value: head(major, value) for value in range(256)})
        self._major = major

    def __missing__(self, value: int) -> bytes:
        return head(self._major, value)


def repaired(text: bytes) -> bytes:
    """UTF-8 for bytes that may not be UTF-8."""
    return str(text, "utf-8", "replace").encode()


class _Column:
    """How a number in a variable is written, by a struct code.

    `form` is "" for the number itself, "bool" for the simple value, the information of the head (as decimal) for
    the head of a signed integer, and "magnitude" for what follows that head.
    """

    def __init__(self, code: str, variable: str, form: str = "") -> None:
        self.code = code
        self.variable = variable
        self.form = form

    def expression(self) -> str:
        """What is packed, for a number in a Python variable."""
        if self.form == "bool":
            return f"244 + {self.variable}"
        if self.form == "magnitude":
            return f"{self.variable} if {self.variable} >= 0 else ~{self.variable}"
        if self.form:
            width = int(self.form)
            return f"{width} if {self.variable} >= 0 else {width + 32}"
        return self.variable

    def convert(self, values: Any) -> Any:
        """The same for a column of numbers."""
        if self.form == "bool":
            return (values != 0) + np.uint8(244)
        if self.form == "magnitude":
            return np.where(values >= 0, values, ~values)
        if self.form:
            width = int(self.form)
            return np.where(values >= 0, np.uint8(width), np.uint8(width + 32))
        return values


class _CborWriter(WireWalk):
    """Generates the CBOR of fields; `columns` is what is written while a row of a table is laid out."""

    def __init__(self, source: Source, pieces: Pieces, bulk: bool) -> None:
        super().__init__(source)
        self.pieces = pieces
        self._bulk = bulk
        self._columns: List[Union[bytes, _Column]] = []

    # What the fields become.

    def fields(self, fields: Tuple[Field, ...]) -> None:
        self._text(head(_MAP, len(fields)))
        for field in fields:
            name = field.name.encode()
            self._text(head(_TEXT, len(name)) + name)
            self.value(field)

    def value(self, field: Field) -> None:
        if not field.is_array:
            self.element(field)
        elif field.type in NUMBER_CODES:
            self.numbers(field)
        else:
            self.items(field)

    def element(self, field: Field) -> None:
        if field.message is not None:
            self.fields(field.message.fields)
        elif field.type == "string":
            self.string()
        elif field.type in TIME_CODES:
            self._text(head(_MAP, 2) + b"\x64secs")
            self.number(TIME_CODES[field.type])
            self._text(b"\x65nsecs")
            self.number(TIME_CODES[field.type])
        else:
            self.number(NUMBER_CODES[field.type])

    def number(self, code: str) -> None:
        variable = self.fixed(code, number_size(code))
        if code == "?":
            self._pack(_Column("B", variable, "bool"))
        elif code in "fd":
            self._text(b"\xfa" if code == "f" else b"\xfb")
            self._pack(_Column(code, variable))
        elif code.isupper():
            self._text(bytes([_WIDTHS[code]]))
            self._pack(_Column(code, variable))
        else:
            unsigned = code.upper()
            self._pack(_Column("B", variable, str(_WIDTHS[unsigned])))
            self._pack(_Column(unsigned, variable, "magnitude"))

    def string(self) -> None:
        name = self.source.fresh("s")
        raw = self.take(self.count())
        self.source.line(f"{name} = bytes(wire[{raw}])" if self._bulk else f"{name} = wire[{raw}]")
        with self.source.block(f"if not {name}.isascii():"):
            self.source.line(f"{name} = repaired({name})")
        self.pieces.piece(f"TEXT[len({name})]")
        self.pieces.piece(name)

    def numbers(self, field: Field) -> None:
        code = NUMBER_CODES[field.type]
        size = number_size(code)
        if field.length is not None:
            self._text(_array_head(code, field.length))
            raw = self.fixed(f"{field.length * size}s", field.length * size)
            if code == "?":
                self.pieces.piece(f"{raw}.translate(BOOLS)")
            else:
                self._pack(_Column(f"{field.length * size}s", raw))
            return
        count = self.count()
        if code in ARRAY_TAGS:
            self._text(head(_TAG, ARRAY_TAGS[code]))
        length = count if size == 1 else f"{count} * {size}"
        self.pieces.piece("{}[{}]".format("ARRAY" if code == "?" else "BYTES", length))
        raw = self.take(length)
        if code == "?":
            self.pieces.piece(f"bytes(wire[{raw}]).translate(BOOLS)")
        else:
            self.pieces.piece("{}[{}]".format("wire" if self.depth else "bulk", raw))

    def items(self, field: Field) -> None:
        """An array of messages, strings or times."""
        count = str(field.length)
        if field.length is not None:
            self._text(head(_ARRAY, field.length))
        else:
            count = self.count()
            self.pieces.piece(f"ARRAY[{count}]")
        width = _element_width(field)
        if field.length is not None and width is not None and width * field.length <= INLINE_NUMBERS:
            for _ in range(field.length):
                self.element(field)
        elif width is not None and width <= ROW_NUMBERS:
            self._rows(field, count)
        elif self.depth or not is_memorable(field):
            self._loop(field, count)
        else:
            self.flush()
            self.pieces.emit()
            made = self.source.fresh("l")
            with self.remembered(count, made, b""):
                self.source.line("outer, out = out, []")
                self._loop(field, count)
                self.source.line(f'{made}, out = b"".join(out), outer')
            self.pieces.piece(made)

    def _loop(self, field: Field, count: str) -> None:
        self.flush()
        self.pieces.emit()
        with self.elements(field, count):
            self.element(field)
            self.flush()
            self.pieces.emit()

    def _rows(self, field: Field, count: str) -> None:
        """An array of elements of a fixed size, none of which is looked at by itself."""
        outer, self.pieces = self.pieces, Pieces(self.source, ">")
        outer_columns, self._columns = self._columns, []
        start = raw = ""
        if field.element_size:
            self.flush()
            start = self.position
            raw = self.take(f"{count} * {field.element_size}")
        else:
            self.check_count(field, count)
        with self.row():
            self.element(field)
            run, rows, target = self.run, self.row_reader(), self.names_of_run()
        (row,) = self.pieces.take()
        table = self.source.constant("table", field, Table(run, self._columns))
        self.pieces, self._columns = outer, outer_columns
        if not raw:
            self.pieces.piece(f"{row} * {count}")
            return
        by_rows = f'b"".join([{row} for {target} in {rows}(wire[{raw}])])'
        by_columns = f"{table}(wire, {count}, {start})"
        if field.length is None:
            self.pieces.piece(f"{by_rows} if {count} < {TABLE_ROWS} else {by_columns}")
        else:
            self.pieces.piece(by_rows if field.length < TABLE_ROWS else by_columns)

    def _text(self, constant: bytes) -> None:
        self.pieces.text(constant)
        self._columns.append(constant)

    def _pack(self, column: _Column) -> None:
        self.pieces.pack(column.code, column.expression())
        self._columns.append(column)


class Table:
    """The CBOR of an array of fixed-size elements, made column by column."""

    def __init__(self, run: Sequence[Tuple[str, str]], columns: Sequence[Union[bytes, _Column]]) -> None:
        self._wire_type = np.dtype([(name, _numpy_type("<", code)) for code, name in run if code != "0s"])
        self._template = b""
        self._columns: List[Tuple[str, str, Callable[[Any], Any]]] = []
        offsets: List[int] = []
        formats: List[str] = []
        for column in columns:
            if isinstance(column, bytes):
                self._template += column
            elif column.code != "0s":
                self._columns.append((f"c{len(offsets)}", column.variable, column.convert))
                offsets.append(len(self._template))
                formats.append(_numpy_type(">", column.code))
                self._template += bytes(struct.calcsize(">" + column.code))
        names = [name for name, _, _ in self._columns]
        self._row_type = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": len(self._template)}
        )

    def __call__(self, wire: bytes, count: int, start: int) -> bytearray:
        """The CBOR of `count` elements that begin at `start`; raises ValueError when the wire bytes end before."""
        elements = np.frombuffer(wire, self._wire_type, count, start)
        written = bytearray(self._template) * count
        rows = np.frombuffer(written, self._row_type)
        for column, variable, convert in self._columns:
            rows[column] = convert(elements[variable])
        return written


def _numpy_type(order: str, code: str) -> str:
    return "V" + code[:-1] if code[-1] == "s" else order + NUMPY_TYPES[code].lstrip("<")


def _array_head(code: str, count: int) -> bytes:
    if code == "?":
        return head(_ARRAY, count)
    tag = head(_TAG, ARRAY_TAGS[code]) if code in ARRAY_TAGS else b""
    return tag + head(_BYTES, count * number_size(code))


def _element_width(field: Field) -> Optional[int]:
    """How many variables an element takes in a run; None when its size varies, or it is not all of one run."""
    if field.message is None:
        return None if field.type == "string" else 2 if field.type in TIME_CODES else 1
    total = 0
    for inner in field.message.fields:
        if not inner.is_array:
            width = _element_width(inner)
        elif inner.length is None or inner.type == "bool":
            width = None
        elif inner.type in NUMBER_CODES:
            width = 1
        else:
            width = _element_width(inner)
            width = None if width is None or width * inner.length > INLINE_NUMBERS else width * inner.length
        if width is None:
            return None
        total += width
    return total


def _has_bulk(plan: Plan) -> bool:
    """Whether a message has a numeric array of variable length that is not inside another array."""
    for field in plan.fields:
        if field.is_array:
            if field.length is None and field.type in NUMBER_CODES:
                return True
        elif field.message is not None and _has_bulk(field.message):
            return True
    return False


def compile_cbor_writer(plan: Plan) -> Callable[[Any], bytes]:
    """A function from the wire bytes of a message to its CBOR; it raises WireError."""
    return _compile_cbor(plan, joined=True)


def compile_cbor_pieces(plan: Plan) -> Callable[[Any], Tuple[Any, ...]]:
    """A function from the wire bytes of a message to pieces of its CBOR, some of them views; it raises WireError."""
    return _compile_cbor(plan, joined=False)


def _compile_cbor(plan: Plan, joined: bool) -> Callable[[Any], Any]:
    source = Source(f"{plan.name} to_cbor")
    source.use(repaired=repaired, TEXT=Heads(_TEXT), BYTES=Heads(_BYTES), ARRAY=Heads(_ARRAY), BOOLS=_BOOLS)
    bulk = _has_bulk(plan)
    with walk_function(source, plan):
        if bulk:
            source.line(f"bulk = wire if end < {BULK_BYTES} else memoryview(wire)")
        else:
            with source.block("if type(wire) is not bytes:"):
                source.line("wire = bytes(wire)")
        source.line("out = []")
        writer = _CborWriter(source, Pieces(source, ">"), bulk)
        writer.fields(plan.fields)
        writer.finish()
        source.line(f"return {writer.pieces.result(joined)}")
    return source.compile("convert")
