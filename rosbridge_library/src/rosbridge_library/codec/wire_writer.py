# SPDX-License-Identifier: BSD-3-Clause
"""Compiling Python values → wire bytes: the way of what clients publish.

The generated function takes the fields out of the nested dictionaries, tests each for the usual type, and packs them
in runs. Whatever is not of the usual type, or left out, is handed to `conformance`, which knows the rules.
"""

from __future__ import annotations

from typing import Any, Callable, List, Mapping, Sequence, Tuple

from . import conformance
from .conformance import Misfit, Now
from .definition import INTEGER_RANGES, NUMBER_CODES, TIME_CODES, Field, Plan, is_header_field, is_header_plan
from .pieces import Pieces
from .source import Source
from .wire_walk import number_size


class _WireWriter:
    """Generates the conversion of fields; `depth` is that of loops, whose indices are i1, i2 …"""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.pieces = Pieces(source, "<")
        self.depth = 0

    def message(self, value: str, plan: Plan, path: str) -> None:
        """A message whose values are in a dict."""
        variables = self._fetch(value, [field.name for field in plan.fields], path)
        is_header = is_header_plan(plan)
        for field, variable in zip(plan.fields, variables):
            if is_header:  # roslibpy sends null for what its program did not give
                with self.source.block(f"if {variable} is None:"):
                    self.source.line(f"{variable} = LEFT_OUT")
            if is_header and field.name == "seq":
                with self.source.block(f"if {variable} is LEFT_OUT:"):
                    self.source.line(f"{variable} = 0")
            where = f"{path}.{field.name}" if path else field.name
            if field.is_array:
                self.array(field, variable, where)
            else:
                self.element(field, variable, where, stamp=is_header and field.name == "stamp")

    def _fetch(self, value: str, names: Sequence[str], path: str) -> List[str]:
        """Take the fields out of a dict: the variables that have them."""
        known = self.source.constant("NAMES", tuple(names), tuple(names))
        variables = [self.source.fresh("f") for _ in names]
        if not names:
            with self.source.block(f"if {value}:"):
                self.source.line(f"unknown({value}, {known}, {path!r})")
            return variables
        with self.source.block("try:"):
            for variable, name in zip(variables, names):
                self.source.line(f'{variable} = {value}["{name}"]')
            with self.source.block(f"if len({value}) != {len(names)}:"):
                self.source.line(f"unknown({value}, {known}, {path!r})")
        with self.source.block("except KeyError:"):
            self.source.line("{}, = partial({}, {}, {!r})".format(", ".join(variables), value, known, path))
        return variables

    def element(self, field: Field, value: str, path: str, stamp: bool = False) -> None:
        if field.message is not None:
            plan = self.source.constant("PLAN", field.type, field.message)
            convert = "header" if is_header_field(field) else "mapping"
            arguments = f"{plan}, now" if is_header_field(field) else plan
            self._unless(f"type({value}) is not dict", value, convert, path, arguments)
            self.message(value, field.message, path)
        elif field.type == "string":
            self.string(value, path)
        elif field.type in TIME_CODES:
            convert = "stamp" if stamp else field.type
            self._unless(f"type({value}) is not dict", value, convert, path, "now" if field.type == "time" else "")
            for half, name in zip(self._fetch(value, ["secs", "nsecs"], path), ("secs", "nsecs")):
                self.number(TIME_CODES[field.type], half, f"{path}.{name}")
        else:
            self.number(NUMBER_CODES[field.type], value, path)

    def number(self, code: str, value: str, path: str) -> None:
        if code == "?":
            self._unless(f"{value} is not True and {value} is not False", value, "boolean", path)
        elif code == "d":
            self._unless(f"type({value}) is not float", value, "real", path, '"d"')
        elif code == "f":
            limit = conformance.MAX_FLOAT32
            unusual = f"type({value}) is not float or not -{limit!r} < {value} < {limit!r}"
            self._unless(unusual, value, "real", path, '"f"')
        else:
            low, high = INTEGER_RANGES[code]
            unusual = f"type({value}) is not int or not {low} <= {value} <= {high}"
            self._unless(unusual, value, "integer", path, f'"{code}"')
        self.pieces.pack(code, value)

    def string(self, value: str, path: str) -> None:
        self._unless(f"type({value}) is not str", value, "text", path)
        raw = self.source.fresh("s")
        self.source.line(f"{raw} = {value}.encode() if {value}.isascii() else encoded({value}, {path!r})")
        self.pieces.pack("I", f"len({raw})")
        self.pieces.piece(raw)

    def array(self, field: Field, value: str, path: str) -> None:
        spec = self.source.constant("FIELD", field, field)
        if field.type == "string":
            texts = self.source.fresh("a")
            self.source.line(f"{texts} = texts({value}, {path!r}, missing, {spec})")
            if field.length is None:
                self.pieces.pack("I", f"len({texts})")
            self.pieces.piece(f'b"".join({texts})')
            return
        if field.type not in NUMBER_CODES:
            self.elements(field, value, path, spec)
            return
        raw = self.source.fresh("a")
        convert = "binary" if field.is_binary else "numbers"
        self.source.line(f"{raw} = {convert}({value}, {path!r}, missing, {spec})")
        size = number_size(NUMBER_CODES[field.type])
        if field.length is None:
            self.pieces.pack("I", f"len({raw})" if size == 1 else f"len({raw}) // {size}")
        self.pieces.piece(raw)

    def elements(self, field: Field, value: str, path: str, spec: str) -> None:
        """An array of messages or times: a loop."""
        unusual = f"type({value}) is not list"
        if field.length is not None:
            unusual += f" or len({value}) != {field.length}"
        self._unless(unusual, value, "sequence", path, spec)
        if field.length is None:
            self.pieces.pack("I", f"len({value})")
        self.pieces.emit()
        self.depth += 1
        item = self.source.fresh("f")
        with self.source.block(f"for i{self.depth}, {item} in enumerate({value}):"):
            self.element(field, item, path + "[]")
            self.pieces.emit()
        self.depth -= 1

    def _unless(self, unusual: str, value: str, convert: str, path: str, arguments: str = "") -> None:
        """Have a value converted when a test finds it unusual."""
        with self.source.block(f"if {unusual}:"):
            more = ", " + arguments if arguments else ""
            self.source.line(f"{value} = {convert}({value}, {path!r}, missing{more})")


def _loop_depth(plan: Plan) -> int:
    """How deep the loops over arrays nest that a message needs."""
    depths = [0]
    for field in plan.fields:
        inner = _loop_depth(field.message) if field.message is not None else 0
        depths.append(inner + (field.is_array and field.type not in NUMBER_CODES and field.type != "string"))
    return max(depths)


def compile_wire_writer(plan: Plan) -> Callable[[Mapping[str, Any], Now], Tuple[bytes, List[str]]]:
    """A function from (values, now) to the wire bytes, and the paths of the fields that were left out.

    It raises FieldTypeMismatchException and NonexistentFieldException.
    """
    body = Source(f"{plan.name} from_values")
    names = "unknown partial mapping header time stamp duration real integer boolean text encoded"
    names += " sequence texts binary numbers"
    body.use(**{name: getattr(conformance, name) for name in names.split()})
    body.use(LEFT_OUT=conformance.LEFT_OUT, Misfit=Misfit, NAME=plan.name, PLAN=plan)
    writer = _WireWriter(body)
    indices = [f"i{depth + 1}" for depth in range(_loop_depth(plan))]
    with body.block("def convert(values, now):"):
        body.line("missing = {}")
        if indices:
            body.line("out = []")
            body.line("{} = 0".format(" = ".join(indices)))
        with body.block("try:"):
            with body.block("if type(values) is not dict:"):
                body.line('values = mapping(values, "", missing, PLAN)')
            writer.message("values", plan, "")
            body.line(f"return {writer.pieces.result(joined=True)}, list(missing)")
        with body.block("except Misfit as misfit:"):
            body.line("raise misfit.error(NAME, [{}]) from misfit.__cause__".format(", ".join(indices)))
    return body.compile("convert")
