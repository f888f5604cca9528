"""Files of a small episode, right or with one cell changed."""

from __future__ import annotations

from pathlib import Path

from tpcd.data import Episode, read_episode

HEADER = "step,u_x,u_z,u_phi,x,z,phi,F_x,F_z,tau"
ROWS = [
    "0,0.0,0.05,0.0,0.0,0.05,0.0,0.0,0.0,0.0",
    "1,0.0,0.02,0.0,0.0,0.03,0.0,0.0,1.0,0.1",
    "2,0.01,0.01,0.0,0.008,0.03,0.0,-0.2,2.0,0.2",
]
YAML = "stiffness: [100, 100, 50]\nsensor_std: [2e-4, 0.0002, 0.0005, 0.3, 0.3, 0.02]\n"


def write_files(folder: Path, rows: list[str] | str = "", yaml: str | None = YAML) -> Path:
    content = rows if isinstance(rows, str) and rows else "\n".join([HEADER, *(rows or ROWS)])
    (folder / "run.csv").write_text(content + "\n")
    if yaml is not None:
        (folder / "run.yaml").write_text(yaml)
    return folder / "run.csv"


def edit(row: int, column: str, value: str) -> list[str]:
    rows = [line.split(",") for line in ROWS]
    rows[row][HEADER.split(",").index(column)] = value
    return [",".join(cells) for cells in rows]


def sample_episode(tmp_path: Path) -> Episode:
    return read_episode(write_files(tmp_path))
