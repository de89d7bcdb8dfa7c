# SPDX-License-Identifier: BSD-3-Clause
"""The text of a generated function, and its compilation.

Generated code is ordinary Python: it is registered with linecache under a name of its own, so that tracebacks and
debuggers show its lines.
"""

from __future__ import annotations

import itertools
import linecache
import weakref
from contextlib import contextmanager
from typing import Any, Callable, Dict, Iterator, List

_numbers = itertools.count(1)


class Source:
    """Python text that grows line by line, with the constants that it refers to by name."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._lines: List[str] = []
        self._indent = 0
        self._names: Dict[str, int] = {}
        self._constants: Dict[Any, str] = {}
        self._namespace: Dict[str, Any] = {}

    def line(self, text: str) -> None:
        self._lines.append("    " * self._indent + text)

    @contextmanager
    def block(self, head: str) -> Iterator[None]:
        """Lines inside are the body of the statement `head` ("if …:")."""
        self.line(head)
        self._indent += 1
        yield
        self._indent -= 1

    def fresh(self, hint: str) -> str:
        """A variable name that is used nowhere else in this source."""
        number = self._names[hint] = self._names.get(hint, 0) + 1
        return f"{hint}{number}"

    def constant(self, hint: str, key: Any, value: Any) -> str:
        """The name of a global with this value; `key`, hashable, tells which values are the same."""
        known = self._constants.get((hint, key))
        if known is None:
            known = self._constants[hint, key] = self.fresh(hint)
            self._namespace[known] = value
        return known

    def use(self, **values: Any) -> None:
        """Make values known under names of the caller's choice."""
        self._namespace.update(values)

    @property
    def text(self) -> str:
        return "\n".join(self._lines) + "\n"

    def compile(self, function: str) -> Callable[..., Any]:
        """Run the text, and return the function that it defines under this name."""
        filename = f"<codec {self._title} #{next(_numbers)}>"
        text = self.text
        namespace = dict(self._namespace)
        exec(compile(text, filename, "exec"), namespace)
        made: Callable[..., Any] = namespace.pop(function)  # so that nothing but its users keeps it
        linecache.cache[filename] = (len(text), None, text.splitlines(True), filename)
        weakref.finalize(made, linecache.cache.pop, filename, None)
        return made
