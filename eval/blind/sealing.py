"""Sealed cases: episodes in one place, keys in another, bound to verdicts by their hashes.

`episodes/TOKEN` holds what the workflow under test is given and nothing else; `keys/TOKEN.json`
says what was hidden. The SHA-256 of both goes into the line of the verdict before any key is
opened, so that neither can be changed afterwards without notice.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tpcd.data import Episode, read_episode, write_episode
from tpcd.errors import RunError
from tpcd.files import read_json, write_json

MAIN, FRESH = "main", "fresh"


@dataclass(frozen=True)
class Seal:
    """What binds a verdict to its case."""

    case: str
    """Token of the case."""
    key_sha256: str
    episodes_sha256: str


def seal(folder: Path, token: str, main: Episode, fresh: Episode, key: Mapping[str, Any]) -> Seal:
    """Write episodes and key of a case, without names that could tell."""
    for name, episode in ((MAIN, main), (FRESH, fresh)):
        bare = replace(episode, object=None, notes=None)
        write_episode(bare, episode_folder(folder, token) / name, overwrite=True)
    write_json(key_path(folder, token), dict(key))
    return Seal(token, _key_hash(folder, token), _episodes_hash(folder, token))


def read_sealed(folder: Path, token: str) -> tuple[Episode, Episode]:
    """The episode to diagnose and the fresh one, from their files alone."""
    place = episode_folder(folder, token)
    return read_episode(place / f"{MAIN}.csv"), read_episode(place / f"{FRESH}.csv")


def open_key(folder: Path, sealed: Seal) -> dict[str, Any]:
    """The key of a case; raises `RunError` where it or the episodes are not those sealed."""
    path = key_path(folder, sealed.case)
    if not path.is_file():
        raise RunError(path, "is missing", "the verdicts cannot be scored without it")
    if _key_hash(folder, sealed.case) != sealed.key_sha256:
        raise RunError(path, "is not the key that was sealed", "run the case again")
    if _episodes_hash(folder, sealed.case) != sealed.episodes_sha256:
        place = episode_folder(folder, sealed.case)
        raise RunError(place, "holds other episodes than were diagnosed", "run the case again")
    return read_json(path)


def episode_folder(folder: Path, token: str) -> Path:
    """Where the episodes of a case lie."""
    return folder / "episodes" / token


def key_path(folder: Path, token: str) -> Path:
    """Where the key of a case lies."""
    return folder / "keys" / f"{token}.json"


def _key_hash(folder: Path, token: str) -> str:
    return hashlib.sha256(key_path(folder, token).read_bytes()).hexdigest()


def _episodes_hash(folder: Path, token: str) -> str:
    found = hashlib.sha256()
    for path in sorted(episode_folder(folder, token).iterdir()):
        content = path.read_bytes()
        found.update(f"{path.name} {len(content)}\n".encode() + content)
    return found.hexdigest()
