"""Whose a folder is while work in it goes on: one process's, told by a lock beside the folder.

The lock of `runs/mug` is the file `runs/.mug.lock`, or `runs/mug/.mug.lock` where nothing can be
put beside the folder. The kernel holds it for the process (`flock`) and lets go of it when that
ends, however it ends, so that a lock which a killed process left behind holds nobody up. What is
written in it says who the owner is.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from tpcd.errors import RunError
from tpcd.files import named
from tpcd.targets import check_place

try:
    import fcntl
except ImportError:  # not a Unix
    fcntl = None

NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)
"""What file systems without such locks answer, as some over a network."""


@dataclass(frozen=True)
class Owner:
    """The process that a folder belongs to."""

    command: str
    process: int
    machine: str
    since: str

    def __str__(self) -> str:
        return f"{self.command} (process {self.process} on {self.machine}) since {self.since}"


@contextmanager
def owned(path: str | Path, command: str) -> Iterator[None]:
    """Keep a folder, or the files of one name, for this process as long as the body runs.

    `command` tells others what it is kept for. Folders on the way there are made, and removed in
    the end where nothing has come into them. Raises `RunError` where another process has the
    folder, or one that it lies in, unless that process is one that started this one.
    """
    place = Path(path).resolve()
    lock, new = lock_of(place), [parent for parent in place.parents if not parent.exists()]
    check_place(lock.parent)
    with ExitStack() as held:
        held.callback(_remove_empty, new)
        _take(held, path, lock)
        me = Owner(command, os.getpid(), socket.gethostname(), f"{datetime.now():%Y-%m-%d %H:%M}")
        with named(path):
            lock.write_text(json.dumps(asdict(me)), encoding="utf-8")
        for parent in place.parents:
            owner = _owner(lock_of(parent))
            if owner is not None and owner.process not in _ancestors():
                raise _in_use(path, owner, f"lies in {parent}, which ")
        yield


def check_none_within(path: str | Path) -> None:
    """Raise `RunError` where another process has a folder within this one, which is to go."""
    place = Path(path).resolve()
    for lock in sorted(place.rglob(".*.lock")):
        owner = None if lock == lock_of(place) else _owner(lock)
        if owner is not None and owner.process != os.getpid():
            name = lock.name.removeprefix(".").removesuffix(".lock")
            raise _in_use(path, owner, f"holds {lock.with_name(name)}, which ")


def lock_of(place: Path) -> Path:
    """The lock of a folder: beside it, since it may be moved away, and within it where nothing can
    be put beside."""
    fixed = place.is_dir() and (os.path.ismount(place) or not os.access(place.parent, os.W_OK))
    return (place if fixed else place.parent) / f".{place.name}.lock"


def is_lock(path: Path) -> bool:
    """Whether a file is the lock of the folder that it is in."""
    return path.name == f".{path.resolve().parent.name}.lock"


def _take(held: ExitStack, path: str | Path, lock: Path) -> None:
    """Hold the lock until `held` is closed."""
    while True:
        lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # another process has just removed the folder on the way again
            continue
        except PermissionError:
            owner = _owner(lock)
            if owner is not None:
                raise _in_use(path, owner) from None
            lock.unlink()  # of another user, whose process was killed
            continue
        with ExitStack() as opened:
            opened.callback(os.close, file)
            if not _hold(opened, lock, file):
                raise _in_use(path, _written(lock))
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file), os.stat(lock)):
                    # Removed while it is held: those who have it open then see that it is gone.
                    opened.callback(_remove, lock)
                    held.callback(opened.pop_all().close)
                    return


def _hold(held: ExitStack, lock: Path, file: int, look: bool = False) -> bool:
    """Hold an open lock until `held` is closed, or only `look`; False where another has it."""
    try:
        if fcntl is None:
            raise OSError(errno.ENOSYS, "no flock here")
        fcntl.flock(file, (fcntl.LOCK_SH if look else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        return True
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    from filelock import SoftFileLock, Timeout

    marker = Path(f"{lock}.held")
    if not look:
        told = "the system locks no files there; if a run was killed on another machine, remove"
        print(f"note: {lock.parent}: {told} {marker}", file=sys.stderr)
    try:
        held.enter_context(SoftFileLock(marker, timeout=1.0).acquire())
    except Timeout:
        return False
    return True


def _owner(lock: Path) -> Owner | None:
    """Who has a folder now, from its lock; None where nobody does."""
    try:
        file = os.open(lock, os.O_RDONLY)
    except OSError:
        return None
    with ExitStack() as opened:
        opened.callback(os.close, file)
        return None if _hold(opened, lock, file, look=True) else _written(lock)


def _written(lock: Path) -> Owner:
    try:
        return Owner(**json.loads(lock.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):  # it was taken just now
        return Owner("another process", 0, "some machine", "just now")


def _ancestors() -> list[int]:
    """This process, and those that it was started by."""
    found = [os.getpid(), os.getppid()]
    with suppress(OSError, ValueError, IndexError):  # no /proc: the first two have to do
        while found[-1] > 1:
            status = Path(f"/proc/{found[-1]}/stat").read_text(encoding="utf-8")
            found.append(int(status.rpartition(")")[2].split()[1]))
    return found


def _in_use(path: str | Path, owner: Owner, where: str = "") -> RunError:
    remedy = "wait until it is done, or name another folder"
    return RunError(Path(path), f"{where}is in use by {owner}", remedy)


def _remove(lock: Path) -> None:
    with suppress(OSError):  # its folder may be gone, or on a disk that is
        lock.unlink()


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        with suppress(OSError):  # something has come into it
            folder.rmdir()
