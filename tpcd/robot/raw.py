"""All readings of a move, in Parquet beside the episode: `raw/row_007.parquet` for row 7.

A file for each row, written as soon as the arm is at rest, however the move ended, so that nothing
is lost; a move that is made again after a stop gets a file of its own, `row_007-2.parquet`. Its
metadata name the row, the command and how the move ended. Columns: stamp and time of receipt [s],
TCP pose and target in the base frame, wrench along base axes, and what the task sees of them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tpcd.errors import FileError
from tpcd.robot.link import Sample

BASE_AXES = ("x", "y", "z", "rx", "ry", "rz")
COLUMNS = (
    "stamp",
    "received",
    *(f"tcp_{axis}" for axis in BASE_AXES),
    *(f"wrench_{axis}" for axis in BASE_AXES),
    *(f"target_{axis}" for axis in BASE_AXES),
    "x",
    "z",
    "phi",
    "F_x",
    "F_z",
    "tau",
    "r_x",
    "r_z",
    "r_phi",
)
"""r is the reference of the admittance in the plane."""


class RawRecord:
    """Readings of one move, gathered until they are written."""

    def __init__(self) -> None:
        self._rows: list[np.ndarray] = []

    def __len__(self) -> int:
        """Readings gathered."""
        return len(self._rows)

    def add(
        self,
        sample: Sample,
        pose: Float[np.ndarray, " 3"],
        wrench: Float[np.ndarray, " 3"],
        reference: Float[np.ndarray, " 3"],
    ) -> None:
        """Append a reading and what the task sees of it."""
        times = np.array([sample.stamp, sample.received])
        parts = (times, sample.tcp, sample.wrench, sample.target, pose, wrench, reference)
        self._rows.append(np.concatenate(parts))

    def write(self, folder: Path, name: str, about: Mapping[str, Any]) -> Path | None:
        """Write NAME.parquet in one move; None where nothing was read.

        A file of that name stays, and this one becomes NAME-2, NAME-3, ... Raises FileError where
        it cannot be written; the readings stay.
        """
        if not self._rows:
            return None
        import pyarrow
        import pyarrow.parquet

        table = np.array(self._rows)
        content = pyarrow.table({key: table[:, i] for i, key in enumerate(COLUMNS)})
        content = content.replace_schema_metadata({"tpcd": json.dumps(dict(about))})
        path, count = folder / f"{name}.parquet", 1
        try:
            folder.mkdir(parents=True, exist_ok=True)
            while path.exists():
                count += 1
                path = folder / f"{name}-{count}.parquet"
            temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
            try:
                pyarrow.parquet.write_table(content, temporary)
                os.replace(temporary, path)
            finally:
                temporary.unlink(missing_ok=True)
        except OSError as error:
            problem = f"cannot be written: {error.strerror or error}"
            raise FileError(path, problem, "see to the disk") from error
        return path
