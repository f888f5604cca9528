"""Fits that are kept in a folder, so that a diagnosis that was stopped goes on where it was.

Every fit follows from what is asked, the effects, the seed and the fits it starts from, all of
which make its key; one that is found under its key need not be made again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_tensors
from torch import Tensor

from tpcd.errors import RunError
from tpcd.files import write_bytes

T = TypeVar("T")


def _unwatched(what: str) -> None:
    """Nobody watches."""


@dataclass(frozen=True)
class Memory:
    """A folder of what was worked out; None keeps nothing."""

    folder: Path | None = None
    salt: str = ""
    """Part of every key, such as a fingerprint of code that files hold."""
    watch: Callable[[str], None] = _unwatched
    """Told what comes next, in words: a diagnosis takes minutes."""

    def recall(self, what: str, key: Sequence[object], kind: type[T], work: Callable[[], T]) -> T:
        """A data class of tensors, numbers and tuples of them, from the folder or from `work`;
        `what` is it, in words.

        Raises `RunError` for a file that cannot be read.
        """
        self.watch(what)
        if self.folder is None:
            return work()
        path = self.folder / f"{digest(self.salt, *key)}.safetensors"
        if path.is_file():
            return _read(path, kind)
        found = work()
        own = {field.name: getattr(found, field.name) for field in fields(found)}  # type: ignore[arg-type]
        tensors = {k: v.contiguous() for k, v in own.items() if isinstance(v, Tensor)}
        plain = {k: v for k, v in own.items() if not isinstance(v, Tensor)}
        # A file needs one tensor at least.
        tensors = tensors or {"": torch.zeros(0)}
        write_bytes(path, save_tensors(tensors, {"": json.dumps(plain)}))
        return found


def _read(path: Path, kind: type[T]) -> T:
    try:
        with safe_open(path, framework="pt") as file:
            # Cloned, since products of matrices round by how their memory is aligned.
            tensors = {k: file.get_tensor(k).clone() for k in file.keys() if k}  # noqa: SIM118
            plain = json.loads(file.metadata()[""])
        tuples = {k: tuple(v) if isinstance(v, list) else v for k, v in plain.items()}
        return kind(**tensors, **tuples)
    except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
        raise RunError(
            path, f"cannot be read ({error})", "remove it, and diagnose again"
        ) from error


def digest(*parts: object) -> str:
    """A short fingerprint of tensors, by their numbers, and of all else, by what it prints."""
    found = hashlib.sha256()
    for part in parts:
        raw = part.numpy().tobytes() if isinstance(part, Tensor) else repr(part).encode()
        found.update(str(len(raw)).encode() + b":" + raw)
    return found.hexdigest()[:24]
