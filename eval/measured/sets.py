"""Which real recordings there are, and how each becomes a table that the commands read.

The sets are not part of the project: the environment variable `TPCD_MEASURED` names their folder.
Tables made from them go into the run's folder and nowhere else.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tpcd.errors import FileError
from tpcd.logs.columns import log_from_columns
from tpcd.logs.log import Log
from tpcd.logs.table import read_columns

FOLDER_VARIABLE = "TPCD_MEASURED"
QUATERNION, WRENCH = ("qx", "qy", "qz", "qw"), ("F_x", "F_y", "F_z", "T_x", "T_y", "T_z")


@dataclass(frozen=True)
class Recording:
    """A table of one recording, and how the commands are told to read it."""

    name: str
    set: str
    table: Path
    map: tuple[str, ...]
    rate: float | None = None
    """Samples a second [Hz], where no times were recorded."""
    stiffness: tuple[float, float, float] = (100.0, 100.0, 50.0)
    """For import, in its plane; of no consequence where commands are unknown."""
    more: tuple[str, ...] = ()
    """Further options of import."""
    known: Mapping[str, float] = field(default_factory=dict)
    """What those who made the set found, by the name of the quantity."""
    notes: tuple[str, ...] = ()
    """What the recording does not say, and what was taken for it."""

    def arguments(self) -> list[str]:
        """How a command is told to read the table."""
        rate = [] if self.rate is None else ["--rate", f"{self.rate:g}"]
        return [str(self.table), *rate, "--map", *self.map]

    def read(self) -> Log:
        """The recording as the commands read it."""
        return log_from_columns(read_columns(self.table), self.map, self.table, rate=self.rate)


def measured_folder() -> Path | None:
    """The folder of the sets, or None where `TPCD_MEASURED` is not set.

    Raises `FileError` where it names no folder.
    """
    named = os.environ.get(FOLDER_VARIABLE)
    if not named:
        return None
    folder = Path(named).expanduser()
    if not folder.is_dir():
        remedy = f"set {FOLDER_VARIABLE} to where the sets are"
        raise FileError(folder, f"the folder {FOLDER_VARIABLE} names does not exist", remedy)
    return folder


def recordings(folder: Path, out: Path) -> list[Recording]:
    """Every recording with a six-axis wrench, with its table; converted ones go to `out`."""
    out.mkdir(parents=True, exist_ok=True)
    return [*_ati(folder / "ati_static_poses", out), *_franka(folder), _iiwa(folder)]


def write_table(path: Path, columns: Mapping[str, np.ndarray]) -> Path:
    """A table of named columns, with digits enough to give the same numbers."""
    table = np.column_stack(list(columns.values()))
    header = ",".join(columns)
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.17g")
    return path


UPSTREAM = {
    "weight": -10.804,
    **{f"force_bias_{a}": v for a, v in zip("xyz", (-2.136, -2.764, -13.077), strict=True)},
    **{f"torque_bias_{a}": v for a, v in zip("xyz", (-0.157, -0.079, 0.130), strict=True)},
}
"""Of the seven static poses, by those who recorded them [N, N·m]."""


def _ati(folder: Path, out: Path) -> list[Recording]:
    """Seven static poses in two files, the wrench in axes of the base; and one file over time
    without a header, the wrench in axes of the sensor and no positions."""
    poses = np.loadtxt(folder / "recorded_messages_pose.txt", delimiter=",")
    wrenches = np.loadtxt(folder / "recorded_messages_wrench.txt", delimiter=",")
    names = ("x", "y", "z", *QUATERNION, *WRENCH)
    values = np.column_stack((poses, wrenches))
    static = write_table(out / "ati_static.csv", dict(zip(names, values.T, strict=True)))
    series = np.loadtxt(folder / "GP2025-07-22-22-06-02.txt", delimiter=",")
    nowhere = np.zeros((len(series), 3))
    values = np.column_stack((series[:, :1], nowhere, series[:, 7:], series[:, 1:7]))
    timed = write_table(out / "ati_turning.csv", dict(zip(("time", *names), values.T, strict=True)))
    same = tuple(f"{name}={name}" for name in names)
    return [
        # One row was kept of each rest: ten seconds apart is as good as any.
        Recording(
            "ati, 7 static poses",
            folder.name,
            static,
            same,
            rate=0.1,
            known=UPSTREAM,
            notes=(
                "Poses in one file, wrenches in another, neither with a header or times; one row"
                " of each rest, taken as ten seconds apart.",
                "The wrench is in axes of the base here and of the sensor in the next recording;"
                " nothing tells the commands so.",
            ),
        ),
        Recording(
            "ati, turning",
            folder.name,
            timed,
            ("time=time", *same),
            more=("--window", "2"),
            notes=("No header and no positions, which are set to 0.",),
        ),
    ]


def _franka(folder: Path) -> list[Recording]:
    axes = ("x", "y", "z")
    quaternion = {f"q{a}": f"orientation_{a}" for a in ("w", *axes)}
    entries = [f"{a}=current_pos_{a}" for a in axes]
    entries += [f"{name}=current_{column}" for name, column in quaternion.items()]
    entries += [f"u_{a}=goal_pos_{a}" for a in axes]
    entries += [f"u_{name}=goal_{column}" for name, column in quaternion.items()]
    entries += [f"F_{a}=force_{a}" for a in axes] + [f"T_{a}=torque_{a}" for a in axes]
    tables = sorted((folder / "franka_taskboard").glob("data_trial*.csv"))
    return [
        Recording(
            f"franka, {table.stem.removeprefix('data_')}",
            "franka_taskboard",
            table,
            tuple(entries),
            rate=20.0,
            stiffness=(400.0, 1100.0, 30.0),
            more=("--tare",),
            notes=(
                "No times: 20 Hz are those of the set's own README. Neither frame nor zero of the"
                " wrench is stated, nor a stiffness; the wrench is estimated from joint torques,"
                " so friction of the joints is in it.",
                "Quaternions begin with w; those of the goal are interpolated and not quite of"
                " unit length.",
                "It touches things during most of the recording and is nowhere said to be free.",
            ),
        )
        for table in tables
    ]


def _iiwa(folder: Path) -> Recording:
    table = folder / "iiwa_screw_contact" / "sensor_data.csv"
    entries = ("time=timestamp:ms", "x=X", "y=Y", "z=Z", "e1=A", "e2=B", "e3=C")
    entries += tuple(f"{name}={name.replace('_', '')}" for name in WRENCH)
    stiffness = (2000.0, 1000.0, 200.0)
    notes = ("The set point was not recorded, nor is the frame of the wrench documented.",)
    return Recording("iiwa", "iiwa_screw_contact", table, entries, stiffness=stiffness, notes=notes)
