# SPDX-License-Identifier: BSD-3-Clause
"""Compiling wire bytes → JSON text, and wire bytes → Python values.

Both build nested dictionaries in one expression. For JSON, orjson writes them; numeric arrays are NumPy views on
the wire bytes, which it writes without making Python numbers, and binary data that stands at the top level of the
message is put between pieces of JSON as base64, uncopied.
"""

from __future__ import annotations

import functools
import struct
from typing import Any, Callable, Dict, List, Optional, Tuple

import numpy as np
import orjson
import pybase64

from .definition import NUMBER_CODES, NUMPY_TYPES, TIME_CODES, Field, Plan
from .pieces import joined_pieces
from .source import Source
from .wire_walk import WireWalk, element_code, is_memorable, number_size, walk_function

# Fixed-length arrays of up to so many numbers are read into Python numbers with the run that they stand in; for
# longer ones a NumPy view is cheaper.
INLINE_NUMBERS = 24
# Elements of up to so many numbers are read by one `iter_unpack` for the whole array.
ROW_NUMBERS = 128


class _Reader(WireWalk):
    """Generates the expressions of values; subclasses say what becomes of arrays."""

    def value(self, field: Field) -> str:
        if not field.is_array:
            return self.element(field)
        if field.is_binary:
            return self.binary(field)
        if field.length is not None:
            width = self._width(field)
            if width is not None and width <= INLINE_NUMBERS:
                return "[{}]".format(", ".join([self.element(field) for _ in range(field.length)]))
        if field.type in NUMBER_CODES:
            return self.numbers(field)
        return self.items(field)

    def element(self, field: Field) -> str:
        if field.message is not None:
            return self.fields(field.message.fields)
        if field.type == "string":
            return self.string()
        code = element_code(field)
        size = number_size(code)
        if field.type in TIME_CODES:
            return f'{{"secs": {self.fixed(code, size)}, "nsecs": {self.fixed(code, size)}}}'
        return self.fixed(code, size)

    def fields(self, fields: Tuple[Field, ...]) -> str:
        return "{{{}}}".format(", ".join([f'"{field.name}": {self.value(field)}' for field in fields]))

    def string(self) -> str:
        name = self.source.fresh("s")
        raw = self.take(self.count())
        self.source.line(f'{name} = str(wire[{raw}], "utf-8", "replace")')
        return name

    def binary(self, field: Field) -> str:
        if field.length is not None:
            return self.from_bytes(self.fixed(f"{field.length}s", field.length))
        name = self.source.fresh("b")
        raw = self.take(self.count())
        self.source.line("{} = {}".format(name, self.from_bytes(f"wire[{raw}]")))
        return name

    def numbers(self, field: Field) -> str:
        code = NUMBER_CODES[field.type]
        dtype = self.source.constant("T", code, np.dtype(NUMPY_TYPES[code]))
        if field.length is not None:
            where = self.skip(field.length * number_size(code))
            return self.from_view(f"frombuffer(wire, {dtype}, {field.length}, {where})", code)
        name = self.source.fresh("a")
        count = self.count()
        start = self.position
        view = f"frombuffer(wire, {dtype}, {count}, {start})"
        size = number_size(code)
        self.take(count if size == 1 else f"{count} * {size}")
        few = self.source.constant("FEW", code, _few_unpackers(code))
        self.source.line(f"if {count} < {INLINE_NUMBERS}:")
        self.source.line(f"    {name} = {self.from_tuple(f'{few}[{count}](wire, {start})')}")
        self.source.line("else:")
        self.source.line(f"    {name} = {self.from_view(view, code)}")
        return name

    def items(self, field: Field) -> str:
        """An array of messages, strings or times."""
        return self._items(field, str(field.length) if field.length is not None else self.count())

    def _items(self, field: Field, count: str) -> str:
        name = self.source.fresh("l")
        width = self._element_width(field)
        if field.element_size == 0:
            self.check_count(field, count)
            self.source.line(f"{name} = [{self.element(field)} for _ in range({count})]")
        elif width is not None and width <= ROW_NUMBERS:
            raw = self.take(f"{count} * {field.element_size or 0}")
            with self.row():
                value = self.element(field)
                rows = self.row_reader()
                target = self.names_of_run()
            self.source.line(f"{name} = [{value} for {target} in {rows}(wire[{raw}])]")
        else:
            self.source.line(f"{name} = []")
            with self.elements(field, count):
                value = self.element(field)
                self.flush()
                self.source.line(f"{name}.append({value})")
        return name

    def from_bytes(self, raw: str) -> str:
        raise NotImplementedError

    def from_view(self, view: str, code: str) -> str:
        raise NotImplementedError

    def from_tuple(self, numbers: str) -> str:
        raise NotImplementedError

    def _width(self, field: Field) -> Optional[int]:
        """How many variables reading the field as part of a run takes; None when it cannot be."""
        if not field.is_array:
            return self._element_width(field)
        if field.length is None:
            return None
        if field.is_binary:
            return 1
        width = self._element_width(field)
        return None if width is None or width * field.length > INLINE_NUMBERS else width * field.length

    def _element_width(self, field: Field) -> Optional[int]:
        if field.message is None:
            return None if field.type == "string" else 2 if field.type in TIME_CODES else 1
        total = 0
        for inner in field.message.fields:
            width = self._width(inner)
            if width is None:
                return None
            total += width
        return total


class _ValuesReader(_Reader):
    def from_bytes(self, raw: str) -> str:
        return f"bytes({raw})"

    def from_view(self, view: str, code: str) -> str:
        return f"({view} != 0).tolist()" if code == "?" else f"{view}.tolist()"

    def from_tuple(self, numbers: str) -> str:
        return f"list({numbers})"


class _JsonReader(_Reader):
    def items(self, field: Field) -> str:
        if self.depth or not is_memorable(field):
            return super().items(field)
        count = self.count()
        made = self.source.fresh("l")
        with self.remembered(count, made, orjson.Fragment(b"[]")):
            self.source.line(f"{made} = Fragment(dumps({self._items(field, count)}, None, NUMPY))")
        return made

    def from_bytes(self, raw: str) -> str:
        return f"base64_text({raw})"

    def from_tuple(self, numbers: str) -> str:
        return numbers

    def from_view(self, view: str, code: str) -> str:
        if code == "?":
            return f"{view} != 0"
        if code == "f":
            # The digits of the double that a float32 is, as for a scalar, and as clients have always had them.
            return f"widened({view})"
        # orjson reads the memory as it is: a copy makes it aligned.
        return view if number_size(code) == 1 else f"{view}.copy()"


@functools.lru_cache(maxsize=None)
def _few_unpackers(code: str) -> List[Callable[..., Tuple[Any, ...]]]:
    """Functions that unpack so many numbers of a struct code as their index says."""
    return [struct.Struct(f"<{count}{code}").unpack_from for count in range(INLINE_NUMBERS)]


@np.errstate(invalid="ignore")
def _widened(values: Any) -> Any:
    """float32 as float64; a signalling NaN is not worth the warning that NumPy has for it."""
    return values.astype(_FLOAT64)


_FLOAT64 = np.dtype("f8")


def compile_values_reader(plan: Plan) -> Callable[[Any], Dict[str, Any]]:
    """A function from the wire bytes of a message to its values; it raises WireError."""
    source = Source(f"{plan.name} to_values")
    source.use(frombuffer=np.frombuffer)
    with walk_function(source, plan):
        reader = _ValuesReader(source)
        value = reader.fields(plan.fields)
        reader.finish()
        source.line(f"return {value}")
    return source.compile("convert")


def compile_json_reader(plan: Plan) -> Callable[[Any], bytes]:
    """A function from the wire bytes of a message to its JSON text; it raises WireError."""
    return _compile_json(plan, joined=True)


def compile_json_pieces(plan: Plan) -> Callable[[Any], Tuple[bytes, ...]]:
    """A function from the wire bytes of a message to the pieces of its JSON text; it raises WireError."""
    return _compile_json(plan, joined=False)


def _compile_json(plan: Plan, joined: bool) -> Callable[[Any], Any]:
    source = Source(f"{plan.name} to_json")
    source.use(frombuffer=np.frombuffer, widened=_widened, base64_text=pybase64.b64encode_as_string)
    source.use(
        base64=pybase64.b64encode, dumps=orjson.dumps, Fragment=orjson.Fragment, NUMPY=orjson.OPT_SERIALIZE_NUMPY
    )
    with walk_function(source, plan):
        reader = _JsonReader(source)
        pieces = _json_pieces(reader, plan)
        reader.finish()
        source.line(f"return {joined_pieces(pieces, joined)}")
    return source.compile("convert")


def _json_pieces(reader: _JsonReader, plan: Plan) -> List[str]:
    """Expressions for the JSON text in pieces: binary fields of variable length make pieces of their own."""
    pieces: List[str] = []
    gathered: List[str] = []

    def write_gathered(last: bool) -> None:
        if gathered or (last and not pieces):
            cut = "[{}:{}]".format("1" if pieces else "", "" if last else "-1")
            text = "dumps({{{}}}, None, NUMPY)".format(", ".join(gathered))
            pieces.append(text if cut == "[:]" else text + cut)

    for index, field in enumerate(plan.fields):
        last = index == len(plan.fields) - 1
        if field.is_binary and field.length is None:
            write_gathered(last=False)
            before = "," if gathered else "" if pieces else "{"
            gathered = []
            raw = reader.take(reader.count())
            pieces.append(repr((f'{before}"{field.name}":"').encode()))
            pieces.append(f"base64(memoryview(wire)[{raw}])")
            pieces.append(repr(b'"}' if last else b'",'))
        else:
            gathered.append(f'"{field.name}": {reader.value(field)}')
            if last:
                write_gathered(last=True)
    if not plan.fields:
        write_gathered(last=True)
    return pieces
