"""The demo from end to end, with fewer moves."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_the_demo_learns_an_object_says_how_well_and_runs_again(tmp_path: Path) -> None:
    out = tmp_path / "demo"

    def demo(**settings: int) -> subprocess.CompletedProcess[str]:
        arguments = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
        command = [sys.executable, str(ROOT / "scripts" / "demo.py"), "--out", str(out)]
        return subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=600)

    done = demo(steps=4, tests=2, test_steps=12)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "next:  tensorboard --logdir" in done.stdout
    table = json.loads((out / "results.json").read_text())["table"]
    assert [row["channel"] for row in table] == ["x", "z", "phi", "F_x", "F_z", "tau"]
    assert all(row["rows"] == 24 for row in table)
    assert all(0 < row["mae"] < 0.03 for row in table[:3])  # m, m, rad
    figures = {path.stem for path in (out / "figures").glob("*.png")}
    assert figures == {"estimation", "outline", "scene", "test_0", "test_1", "calibration"}
    # A second one takes its place.
    again = demo(steps=1, tests=1, test_steps=1)
    assert again.returncode == 0, again.stderr[-2000:]
    figures = {path.stem for path in (out / "figures").glob("*.png")}
    assert figures == {"estimation", "outline", "scene", "test_0", "calibration"}
