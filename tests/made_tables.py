"""Tables of one recording, written in every way, and what must be read from them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from made_logs import Setting, an_episode, in_space, sampled
from scipy.spatial.transform import Rotation

from tpcd.logs.log import Log

SETTING = Setting(
    base=Rotation.from_euler("xyz", [0.3, 0.5, 2.0]), tool=Rotation.from_euler("x", 3.0)
)
LONG = in_space(sampled(an_episode(4)), SETTING)
"""Samples of some seconds."""
SPACE = {name: values[180:300] for name, values in LONG.items()}
"""Of a second in which the arm moves."""
SPACE["time"] = SPACE["time"] - SPACE["time"][0]
MAP = ["time=t", *(f"{name}={name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw"))]
MAP += [f"{name}={name}" for name in ("F_x", "F_y", "F_z", "T_x", "T_y", "T_z")]
MAP += [f"u_{name}=u_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
RTDE = ("actual_TCP_pose", "actual_TCP_force", "target_TCP_pose")


def columns(
    rotation: str = "q", samples: Mapping[str, np.ndarray] = SPACE
) -> dict[str, np.ndarray]:
    """All columns in SI units, with rotations as quaternions, vectors (r) or Euler angles (e)."""
    table = {"t": samples["time"]}
    for prefix, place, turn in (("", "position", "rotation"), ("u_", "target", "turned")):
        table.update({prefix + n: samples[place][:, k] for k, n in enumerate("xyz")})
        turns = Rotation.from_quat(samples[turn])
        entries = {
            "q": (("qx", "qy", "qz", "qw"), turns.as_quat()),
            "r": (("rx", "ry", "rz"), turns.as_rotvec()),
            "e": (("e1", "e2", "e3"), turns.as_euler("ZYX")),
        }[rotation]
        table.update({prefix + n: entries[1][:, k] for k, n in enumerate(entries[0])})
    for kind, name in (("F", "force"), ("T", "torque")):
        table.update({f"{kind}_{n}": samples[name][:, k] for k, n in enumerate("xyz")})
    return table


def same(log: Log, atol: float = 1e-6) -> None:
    assert np.allclose(log.times, SPACE["time"], atol=1e-6)
    assert np.allclose(log.positions, SPACE["position"], atol=atol)
    assert np.allclose(log.forces, SPACE["force"], atol=1e-5)
    assert np.allclose(log.torques, SPACE["torque"], atol=1e-5)
    left = log.rotations * Rotation.from_quat(SPACE["rotation"]).inv()
    assert left.magnitude().max() < 1e-6
    assert log.command_positions is not None and log.command_rotations is not None
    assert np.allclose(log.command_positions, SPACE["target"], atol=atol)
    left = log.command_rotations * Rotation.from_quat(SPACE["turned"]).inv()
    assert left.magnitude().max() < 1e-6


def without(*names: str) -> list[str]:
    return [entry for entry in MAP if entry.partition("=")[0] not in names]


def text_of(table: dict[str, np.ndarray], separator: str = ",", comma: bool = False) -> list[str]:
    """The lines of a table, names first."""
    rows = np.column_stack(list(table.values()))
    cells = [[f"{value:.9g}" for value in row] for row in rows]
    if comma:
        cells = [[cell.replace(".", ",") for cell in row] for row in cells]
    return [separator.join(row) for row in ([*table], *cells)]


def measured_folder() -> Path:
    """Where recordings of real arms are: TPCD_MEASURED, or beside the repository."""
    named = os.environ.get("TPCD_MEASURED")
    return Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "measured"


IIWA = measured_folder() / "iiwa_screw_contact" / "sensor_data.csv"
IIWA_MAP = [
    "time=timestamp:ms",
    "x=X",
    "y=Y",
    "z=Z",
    "e1=A",
    "e2=B",
    "e3=C",
    "F_x=Fx",
    "F_y=Fy",
    "F_z=Fz",
    "T_x=Tx",
    "T_y=Ty",
    "T_z=Tz",
]
