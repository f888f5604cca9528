"""Threads for compiled loops, and for small torch operations around them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

CHUNK = 64
"""Fewest transitions handed to a thread at once."""
_ROWS = 512
"""Rows for which `over_threads` takes one more thread: small torch operations in two threads wait
for the interpreter, and for each other. By the time that 100 to 3000 latents take to decode."""


def thread_count() -> int:
    """Threads for compiled loops: OMP_NUM_THREADS where it is set, else the usable cores."""
    limit = os.environ.get("OMP_NUM_THREADS", "")
    usable = getattr(os, "sched_getaffinity", None)
    cores = len(usable(0)) if usable else os.cpu_count() or 1
    return int(limit) if limit.isdecimal() and int(limit) > 0 else cores


def in_parts(work: Callable[[int, int], None], count: int, transitions: int = 1) -> None:
    """Call `work(first, last)` on parts of `count` elements, in as many threads as allowed.

    Each element is so many transitions of work.

    The compiled loops release the interpreter lock. Threads of our own keep them apart from
    the OpenMP of torch, whose number of threads numba's parallel loops would reset, and whose
    threads make the small operations around these loops slow on a busy machine.
    """
    chunks = min(count, math.ceil(count * transitions / CHUNK))
    threads = min(thread_count(), chunks)
    if threads <= 1:
        work(0, count)
        return
    parts = min(4 * threads, chunks)
    bounds = [part * count // parts for part in range(parts + 1)]
    list(_pool(threads).map(work, bounds[:-1], bounds[1:]))


Answer = TypeVar("Answer")
Work = TypeVar("Work", bound=Callable[..., Any])


def over_threads(
    work: Callable[[Tensor], Answer], rows: Tensor, most: int | None = None
) -> list[Answer]:
    """What `work` answers to parts of some rows on the CPU, of so many rows at `most`, in order,
    in a thread for every `_ROWS` rows, as many as allowed. Records no gradient."""

    def alone(own: Tensor) -> Answer:
        # Whether gradients are recorded is a setting of each thread.
        with torch.no_grad():
            return work(own)

    threads = min(thread_count(), math.ceil(len(rows) / _ROWS))
    parts = threads if most is None else max(threads, math.ceil(len(rows) / most))
    if parts <= 1:
        return [alone(rows)]
    each = rows.tensor_split(parts)
    return list(map(alone, each) if threads <= 1 else _pool(threads).map(alone, each))


def torch_in_one_thread(work: Work) -> Work:
    """The same with torch in one thread: it would only get in the way of the compiled loops'
    threads, and between them its operations are small. Its answers then do not depend on how many
    threads torch may take."""

    @wraps(work)
    def alone(*given: Any, **named: Any) -> Any:
        allowed = torch.get_num_threads()
        if allowed == 1:
            return work(*given, **named)
        torch.set_num_threads(1)
        try:
            return work(*given, **named)
        finally:
            torch.set_num_threads(allowed)

    return cast(Work, alone)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="tpcd")
