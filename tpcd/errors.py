"""Errors about the world outside the program: files, checkpoints, solvers, devices.

Wrong arguments of a function raise `ValueError` or `TypeError`. What a user handed in
from outside raises a member of this family, whose message is one line: what was given,
what was expected, what to do. Commands print that line and exit with `exit_code`.
"""

from __future__ import annotations

from pathlib import Path


class TpcdError(Exception):
    """Base of all errors about the outside world."""

    exit_code = 2


class FileError(TpcdError):
    """A file that cannot be used: missing, malformed, or of another version."""

    def __init__(self, path: str | Path, problem: str, remedy: str = "") -> None:
        self.path = Path(path)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{path}: {problem}" + (f"; {remedy}" if remedy else ""))


class EpisodeError(FileError):
    """An episode file that breaks the format; names row and column where there is one."""


class OutlineError(FileError):
    """An outline or mesh that is not one simple closed curve of plausible size."""


class CheckpointError(FileError):
    """A prior checkpoint that is missing, corrupt, or of another format version."""


class ModelError(FileError):
    """A model file, or a file of effects, that is missing or malformed."""


class EffectError(TpcdError):
    """An effect whose code fails or gives back what is no model."""

    def __init__(self, name: str, problem: str, source: str | Path = "") -> None:
        self.name = name
        self.problem = problem
        self.source = str(source)
        super().__init__(f"effect {name!r}" + (f" of {source}" if source else "") + f" {problem}")


class RunError(FileError):
    """A run folder that is missing, incomplete, or would be overwritten."""


class SolverError(TpcdError):
    """A solver engine that is not installed or cannot handle the request."""


class RobotError(TpcdError):
    """An arm that cannot be used, or that had to be stopped."""

    def __init__(self, message: str, resumable: bool = True) -> None:
        """`resumable` says whether the run could go on from where it was."""
        super().__init__(message)
        self.resumable = resumable
