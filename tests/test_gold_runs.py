"""Runs of revision 1747f21, recorded by tests/gold/record_runs.py, give the figures they gave."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from gold.record_runs import EPISODES, HERE, RUNS, figures_of

CHECKOUT = Path(__file__).parents[1]
QUICK = ("estimate", "predict", "explore_grid")
"""Those that run at every test; the others take half a minute to two."""


def same(found: Any, recorded: Any, where: str) -> None:
    """All that was recorded is there, numbers within 1e-6 of their size; more may have come."""
    if isinstance(recorded, dict):
        assert isinstance(found, dict) and recorded.keys() <= found.keys(), where
        for name, value in recorded.items():
            same(found[name], value, f"{where}.{name}")
    elif isinstance(recorded, list):
        assert isinstance(found, list) and len(found) == len(recorded), where
        for k, (one, other) in enumerate(zip(found, recorded, strict=True)):
            same(one, other, f"{where}[{k}]")
    elif isinstance(recorded, float):
        assert math.isclose(found, recorded, rel_tol=1e-6, abs_tol=1e-7), where
    else:
        assert found == recorded, where


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in RUNS]
)
def test_runs_give_what_was_recorded(name: str, tmp_path: Path) -> None:
    assert (EPISODES / "mug.csv").is_file()
    recorded = json.loads((HERE / "runs" / f"{name}.json").read_text(encoding="utf-8"))
    same(figures_of(CHECKOUT, name, tmp_path), recorded, name)
