# SPDX-License-Identifier: BSD-3-Clause
"""Generating code that writes bytes: the other half of what the compilers share.

What is written is a sequence of pieces: constants, packed runs of numbers, and bytes that are there already. Numbers
and constants that follow each other are one call of `Struct.pack`. The pieces are joined once, at the end.
"""

from __future__ import annotations

import struct
from typing import List, Sequence, Tuple

from .source import Source
from .wire_walk import joined_codes


class Pieces:
    """The writing side of a function under generation, which has a list `out` for what loops write."""

    def __init__(self, source: Source, byte_order: str) -> None:
        self._source = source
        self._byte_order = byte_order
        self._packed: List[Tuple[str, str]] = []  # (struct code, expression) of the next pack call
        self._constant = b""  # what follows them
        self._pieces: List[str] = []  # expressions not emitted yet
        self.emitted = False

    def text(self, constant: bytes) -> None:
        """Write constant bytes."""
        self._constant += constant

    def pack(self, code: str, expression: str) -> None:
        """Write a number, or bytes of a fixed length, by its struct code."""
        self._pack_constant()
        self._packed.append((code, expression))

    def piece(self, expression: str) -> None:
        """Write bytes that an expression makes."""
        self._pieces += [*self._close(), expression]

    def take(self) -> List[str]:
        """The expressions of all pieces that were not emitted."""
        pieces = [*self._pieces, *self._close()]
        self._pieces = []
        return pieces

    def emit(self) -> None:
        """Write the pieces so far to `out`; in a loop, and before one."""
        self.emitted = True
        pieces = self.take()
        if len(pieces) == 1:
            self._source.line(f"out.append({pieces[0]})")
        elif pieces:
            self._source.line("out += ({})".format(", ".join(pieces)))

    def result(self, joined: bool) -> str:
        """Expression for all that was written: bytes, or a tuple of pieces."""
        if self.emitted:
            self.emit()
            return 'b"".join(out)' if joined else "tuple(out)"
        return joined_pieces(self.take(), joined)

    def _pack_constant(self) -> None:
        if self._constant:
            constant, self._constant = self._constant, b""
            self._packed.append((f"{len(constant)}s", self._source.constant("K", constant, constant)))

    def _close(self) -> List[str]:
        if not self._packed:
            constant, self._constant = self._constant, b""
            return [self._source.constant("K", constant, constant)] if constant else []
        self._pack_constant()
        packed, self._packed = self._packed, []
        layout = self._byte_order + joined_codes([code for code, _ in packed])
        pack = self._source.constant("P", layout, struct.Struct(layout).pack)
        return ["{}({})".format(pack, ", ".join([expression for _, expression in packed]))]


def joined_pieces(pieces: Sequence[str], joined: bool) -> str:
    """Expression for pieces as bytes, or as a tuple."""
    if not joined:
        return "({})".format("".join([piece + ", " for piece in pieces]))
    if not pieces:
        return 'b""'
    return pieces[0] if len(pieces) == 1 else 'b"".join(({}))'.format(", ".join(pieces))
