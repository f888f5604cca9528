"""How functions are compiled that only other compiled functions call.

They run without numba's reference counts: they allocate nothing, and counting every array they
touch took half of the time. No entry from Python is made for them, which took a fifth of the time
to compile. The large ones are put in place of their calls (`forceinline`): a call hands over every
array field by field, hundreds of numbers, which again took half.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from numba import njit

inner: Callable[..., Any] = partial(
    njit, _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True
)
"""Decorator of such a function; takes the options of `numba.njit`."""
