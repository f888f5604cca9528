"""How loops are compiled, and where numba keeps them.

It keeps them beside the sources, else in the user's cache. In a container, or for another user,
neither may be writable, and numba then refuses to compile at all: here the loops go to a folder of
the user's own below the temporary one, and without such a folder they are compiled anew in each
process. That is told. Wherever they go, what is compiled beside the sources goes there first.
"""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any, no_type_check

from numba import njit
from numba.core import config
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

from tpcd import __version__

FOLDERS = tuple(Path(__file__).parent / name for name in ("belief", "effects", "qp", "simulator"))
"""Where the sources of loops are."""


@no_type_check
def _loop():
    """Stands for a function that numba is to keep."""


def _kept_in(folder: Path) -> Path | None:
    """Where numba keeps loops whose sources are in the folder; None where it finds no place."""
    code = _loop.__code__.replace(co_filename=str(folder / "__init__.py"))
    try:
        return Path(FunctionCache(FunctionType(code, {})).cache_path)
    except RuntimeError:
        return None


def _keep_elsewhere() -> None:
    unwritable = f"neither {FOLDERS[0].parent} nor a cache of the user can be written"
    place = _own_folder()
    if place is None:
        Dispatcher.enable_caching = lambda self: None
        print(f"note: {unwritable}, so that each process compiles its loops", file=sys.stderr)
        return
    config.CACHE_DIR = str(place)  # type: ignore[attr-defined]
    os.environ["NUMBA_CACHE_DIR"] = str(place)  # for the processes that this one starts
    print(f"note: {unwritable}; compiled loops are kept in {place}", file=sys.stderr)


def _copy_loops(beside: Path, place: Path) -> None:
    """Copy what is compiled there, where it is newer; numba asks of which sources it is."""
    for file in beside.glob("*.nb[ci]"):
        kept = place / file.name
        if not kept.exists() or kept.stat().st_mtime < file.stat().st_mtime:
            part = place / f".{file.name}.{os.getpid()}.part"
            shutil.copyfile(file, part)
            os.replace(part, kept)


def _own_folder() -> Path | None:
    """A folder that no other user can write: code in it is run. None where there is none."""
    try:
        parent = Path(tempfile.gettempdir())
    except FileNotFoundError:
        return None
    if parent == Path.cwd():  # Python's last resort, which is a folder of somebody's work
        return None
    user = os.getuid() if hasattr(os, "getuid") else os.getlogin()
    place = parent / f"tpcd-{__version__}-{user}"
    try:
        place.mkdir(mode=0o700, exist_ok=True)
        found = place.lstat()
        others = stat.S_IMODE(found.st_mode) & 0o077
        if stat.S_ISDIR(found.st_mode) and found.st_uid == user and not others:
            return place
    except OSError:
        pass  # a file or a link that somebody else has put there
    place = Path(tempfile.mkdtemp(prefix="tpcd-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    return place


def _find_place() -> None:
    """A place for what numba compiles from now on, with what was compiled beside the sources."""
    if any(_kept_in(folder) is None for folder in FOLDERS):
        _keep_elsewhere()
    for folder in FOLDERS:
        beside, place = folder / "__pycache__", _kept_in(folder)
        if place not in (None, beside):
            _copy_loops(beside, place)


def _forgive_renamed_modules() -> None:
    """Let what was kept with types of modules that are gone be compiled anew, as after an update;
    numba would end in an ImportError."""
    load = IndexDataCacheFile._load_index

    def load_or_forget(self: IndexDataCacheFile) -> dict:
        try:
            return load(self)
        except (ImportError, AttributeError):
            return {}

    IndexDataCacheFile._load_index = load_or_forget  # type: ignore[method-assign]


_find_place()
_forgive_renamed_modules()
inner: Callable[..., Any] = partial(
    njit, _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True
)
"""`njit` for functions that only other compiled functions call; takes the same options.

They run without numba's reference counts: they allocate nothing, and counting every array they
touch took half of the time. No entry from Python is made for them, which took a fifth of the time
to compile. The large ones are put in place of their calls (`forceinline`): a call hands over every
array field by field, hundreds of numbers, which again took half.
"""
