"""Time and peak memory of scripts/check.py on a recording of many rows.

python -m eval.bench.check --rows 1000000

Makes a CSV and a Parquet file of pose, wrench and set point in a temporary folder, checks each in
a process of its own, and prints seconds and the largest memory. The bounds are 60 s and 1 GB.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from tpcd.cli import check_numbers, run
from tpcd.results import format_table

ROOT = Path(__file__).resolve().parents[2]
RATE = 500.0
HOLD = 2.0
"""A command is held for so many seconds."""


@dataclass(frozen=True)
class Checking:
    """Settings of the benchmark."""

    rows: int = 1_000_000
    """Samples of the recording."""
    seed: int = 0
    """Of the noise."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"rows": 1000})


def made(rows: int, seed: int) -> dict[str, np.ndarray]:
    """An arm that goes from hold to hold and feels springs, with noise, a freeze and a rail."""
    random = np.random.default_rng(seed)
    times = np.arange(rows) / RATE
    hold = np.minimum((times / HOLD).astype(int), int(times[-1] / HOLD))
    targets = np.cumsum(0.01 * random.standard_normal((hold[-1] + 1, 3)), axis=0) % 0.2
    command = targets[hold]
    away = 0.02 * np.sin(0.7 * hold)[:, None] * np.ones(3)
    pose = lfilter([0.02], [1.0, -0.98], command + away, axis=0)
    pose = np.asarray(pose) + 1e-5 * random.standard_normal((rows, 3))
    wrench = np.hstack((100.0 * away, 0.5 * away)) + 0.05 * random.standard_normal((rows, 6))
    wrench[rows // 3 : rows // 3 + 2000, 2] = wrench[rows // 3, 2]
    wrench[:, 0] = np.minimum(wrench[:, 0], 2.0)
    columns = {"t": times}
    columns.update({name: pose[:, k] for k, name in enumerate("xyz")})
    columns.update({f"q{name}": np.full(rows, float(name == "w")) for name in "xyzw"})
    columns.update({f"{kind}_{n}": wrench[:, k + 3 * (kind == "T")]
                    for kind in "FT" for k, n in enumerate("xyz")})  # fmt: skip
    columns.update({f"u_{name}": command[:, k] for k, name in enumerate("xyz")})
    return columns


def measure(config: Checking) -> None:
    """Print seconds and peak memory of a check of each kind of file."""
    import pyarrow
    from pyarrow import csv, parquet

    table = pyarrow.table(made(config.rows, config.seed))
    lines = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        parquet.write_table(table, folder / "run.parquet")
        csv.write_csv(table, folder / "run.csv")
        for path in (folder / "run.parquet", folder / "run.csv"):
            command = [sys.executable, str(ROOT / "scripts" / "check.py"), str(path)]
            before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            done = subprocess.run(
                [*command, "--out", str(folder / path.suffix[1:])], capture_output=True, text=True
            )
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            lines.append(
                {
                    "file": path.suffix[1:],
                    "rows": config.rows,
                    "exit code": done.returncode,
                    "seconds": time.perf_counter() - begun,
                    "CPU seconds": after.ru_utime - before.ru_utime,
                    # Largest of all children so far, in kB on Linux.
                    "peak [GB]": after.ru_maxrss / 1e6,
                }
            )
            print(done.stdout.splitlines()[0] if done.stdout else done.stderr)
    print(format_table(lines))


if __name__ == "__main__":
    run(measure, Checking)
