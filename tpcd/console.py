"""Where commands print: what a console cannot show or take any more costs no work.

A console whose encoding lacks a character gets a plain one in its place. A pipe that was closed,
as by `| head -1`, or a full disk behind `> file` ends the printing, not the command.
"""

from __future__ import annotations

import codecs
import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

PLAIN = {"·": "*", "µ": "u", "μ": "u", "°": " deg", "²": "^2", "³": "^3", "±": "+-", "×": "x",
         "→": "->", "≥": ">=", "≤": "<=", "−": "-", "–": "-", "—": "-", "…": "..."}  # fmt: skip
"""Characters that a plain console lacks, and what stands for them; others show as their codes."""
ERRORS = "tpcd.plain"
"""Name of the rule for Python's text streams."""


class Console:
    """A text stream that drops what cannot be written any more; `failure` says why."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write, unless an earlier write has failed."""
        if self.failure is None:
            try:
                self._stream.write(text)
            except OSError as error:
                self.failure = error
        return len(text)

    def flush(self) -> None:
        """Flush, unless an earlier write has failed."""
        if self.failure is None:
            try:
                self._stream.flush()
            except OSError as error:
                self.failure = error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def lost(self) -> OSError | None:
        """Why something could not be written; a reader that has had enough is no reason."""
        closed = self.failure is not None and self.failure.errno in (errno.EPIPE, errno.ESHUTDOWN)
        return None if closed else self.failure

    def close_for_good(self) -> None:
        """Flush, and where that fails let Python's own last flush go nowhere."""
        self.flush()
        if self.failure is not None:
            with suppress(OSError, ValueError), open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())


@contextmanager
def forgiving_console() -> Iterator[Console]:
    """Standard output and standard error as `Console` while the body runs; yields the first."""
    before = sys.stdout, sys.stderr
    with open(os.devnull, "w", encoding="utf-8") as nowhere:  # in place of a stream closed by `>&-`
        for stream in before:
            reconfigure = getattr(stream, "reconfigure", None)
            if reconfigure is not None:
                reconfigure(errors=ERRORS)
        out, error = (Console(stream or nowhere) for stream in before)
        sys.stdout, sys.stderr = out, error
        try:
            yield out
        finally:
            out.close_for_good()
            error.close_for_good()
            sys.stdout, sys.stderr = before


def _plain(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    part = error.object[error.start : error.end]
    return "".join(
        PLAIN.get(c) or c.encode("ascii", "backslashreplace").decode() for c in part
    ), error.end


codecs.register_error(ERRORS, _plain)
