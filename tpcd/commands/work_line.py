"""The last line of a terminal, which says what is being worked on."""

from __future__ import annotations

import sys
from types import TracebackType


class WorkLine:
    """Says since when a command has been running, and what it does now, below what it prints; where
    the error output is no terminal, it only prints."""

    def __init__(self) -> None:
        from tqdm import tqdm

        self._bar = tqdm(
            bar_format="{elapsed} {desc}", disable=None, leave=False, dynamic_ncols=True
        )

    def __enter__(self) -> WorkLine:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.close()

    def begin(self, what: str) -> None:
        """What is done from now on."""
        self._bar.set_description_str(what)

    def tell(self, line: str) -> None:
        """Print a line above."""
        with self._bar.external_write_mode(file=sys.stdout):
            print(line, flush=True)
