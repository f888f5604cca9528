"""Recordings without set points: poses and wrenches alone, in the files of an episode.

The table has the columns step, x, z, phi, F_x, F_z, tau and the YAML says `commands: unknown`.
Such a recording cannot be estimated from, since neither K (x - u) nor the next state means
anything without u; it can be kept, looked at, and answered.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tpcd.data.header import Header, encode_header
from tpcd.data.limits import POSE_COLUMNS, WRENCH_COLUMNS
from tpcd.data.table import encode_table, read_table
from tpcd.errors import EpisodeError

MEASURED_COLUMNS = ("step", *POSE_COLUMNS, *WRENCH_COLUMNS)


class NoCommandsError(EpisodeError):
    """A recording that lacks the set points, handed to what needs them."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(
            path,
            "its YAML says commands: unknown, so nothing can be learnt from it",
            "record the pose that the impedance controller is asked for, and import it as u_x, ...",
        )


@dataclass(frozen=True, eq=False)
class Measured:
    """Rows of a recording without set points."""

    poses: Float[np.ndarray, "n 3"]
    """(x, z, phi) [m, m, rad]."""
    wrenches: Float[np.ndarray, "n 3"]
    """(F_x, F_z, tau) [N, N, N·m]."""
    extra: dict[str, np.ndarray]
    """Further columns."""

    def summary(self) -> str:
        """What such a recording shows, in words: how far it moved and how hard it pressed."""
        span = np.ptp(self.poses, axis=0)
        load = np.linalg.norm(self.wrenches[:, :2], axis=1)
        words = (
            f"the pose moves by {1e3 * span[0]:.2g} mm, {1e3 * span[1]:.2g} mm and"
            f" {np.degrees(span[2]):.2g} degrees under {load.min():.3g} to {load.max():.3g} N"
        )
        if load.min() > load.max() / 2 > 0:
            words += (
                ": one contact held throughout, or nothing but the load and the zero of the sensor;"
                " none made, broken or slid"
            )
        return words


def read_measured(path: Path) -> Measured:
    """The table of a recording without set points; raises `EpisodeError`."""
    table = read_table(path, MEASURED_COLUMNS)
    if not len(table["step"]):
        raise EpisodeError(path, "no rows below the header", "record some")
    poses, wrenches = (
        np.stack([table[name] for name in names], axis=1)
        for names in (POSE_COLUMNS, WRENCH_COLUMNS)
    )
    extra = {name: column for name, column in table.items() if name not in MEASURED_COLUMNS}
    return Measured(poses, wrenches, extra)


def measured_contents(measured: Measured, header: Header, stem: Path) -> dict[Path, bytes]:
    """What the files NAME.csv and NAME.yaml of such a recording hold."""
    table = {"step": np.arange(len(measured.poses), dtype=np.int64)}
    for names, values in (
        (POSE_COLUMNS, measured.poses),
        (WRENCH_COLUMNS, measured.wrenches),
    ):
        table.update({name: values[:, axis] for axis, name in enumerate(names)})
    path = stem.with_name(stem.name + ".csv")
    return {
        path: encode_table({**table, **measured.extra}, path),
        stem.with_name(stem.name + ".yaml"): encode_header(header),
    }
