"""Ctrl-C while an arm moves: it waits until somebody looks, and a servo loop looks at each reading.

Python raises KeyboardInterrupt between any two of its instructions, also between the end of a move
and what would bring the arm to rest. So while an arm moves, signals that have a handler in Python
are only noted, and their handlers are called where an error is expected.
"""

from __future__ import annotations

import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

NUMBERS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGINT") if hasattr(signal, name)
)
"""Let go of in this order, the likeliest one last."""


@contextmanager
def kill_as_ctrl_c() -> Iterator[None]:
    """A block in which `kill` and a terminal that closes are as Ctrl-C, where nothing else is said
    of them: by themselves they would end the program and leave the arm where it presses."""
    before = {
        number: signal.signal(number, signal.default_int_handler)
        for number in NUMBERS
        if signal.getsignal(number) is signal.SIG_DFL
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class HeldSignals:
    """Signals that wait. Handlers belong to the main thread: in others nothing is held, for there
    nothing is raised either."""

    def __init__(self) -> None:
        """Nothing is held yet."""
        self._handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}
        self._waiting: deque[tuple[int, FrameType | None]] = deque()
        self._held = False

    def hold(self) -> None:
        """From here on signals wait."""
        if not _in_main_thread():
            return
        self._held = True
        for number in NUMBERS:
            handler = signal.getsignal(number)
            if callable(handler) and handler != self._take:
                self._handlers[number] = handler
                signal.signal(number, self._take)

    def look(self) -> None:
        """Call the handlers of what waits: for Ctrl-C this raises KeyboardInterrupt."""
        while self._waiting and _in_main_thread():
            number, frame = self._waiting.popleft()
            self._handlers[number](number, frame)

    def release(self) -> None:
        """No signal waits any more; the handlers of what waited are called, and may raise."""
        if not _in_main_thread():
            return
        self._held = False
        try:
            self.look()
        finally:
            for number, handler in self._handlers.items():
                if signal.getsignal(number) == self._take:
                    signal.signal(number, handler)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self._held:
            self._waiting.append((number, frame))
        else:
            self._handlers[number](number, frame)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
