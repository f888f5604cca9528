"""Runs of revision 1747f21, recorded by tests/gold/record_runs.py, give the figures they gave."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gold.record_runs import EPISODES, HERE, RUNS, figures_of

CHECKOUT = Path(__file__).parents[1]
QUICK = ("estimate", "predict", "explore_grid")
"""Those that run at every test; the others take half a minute to two."""


EXACT = ("estimate_paper", "predict_paper")
"""Runs that draw without derivatives; those of other runs are added in another order now, to which
a sampler answers with other draws of the same posterior."""


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


def alike(found: dict[str, Any], recorded: dict[str, Any]) -> None:
    """The same verdict and choices, and moments as far apart as those of two samples may be."""
    assert found["code"] == recorded["code"]
    steps = zip(found.get("steps", []), recorded.get("steps", []), strict=True)
    chosen = [(one.get("command"), other.get("command")) for one, other in steps]
    if any(one != other for one, other in chosen[1:]):
        # A choice among a continuum ends elsewhere, and what is learnt from it too.
        assert chosen[0][0] == pytest.approx(chosen[0][1], abs=1e-9)
        return
    if "belief" in recorded and "verdict" not in recorded:
        own, other = found["belief"], recorded["belief"]
        assert own["names"] == other["names"]
        (mean, sd), (expected, width) = (
            (np.array(each["vectors"]["mean"]), np.array(each["vectors"]["sd"]))
            for each in (own, other)
        )
        assert (np.abs(mean - expected) < 0.3 * width).all()
        assert (np.abs(np.log(sd / width)) < 0.3).all()
        error = math.hypot(own["log_evidence_std"], other["log_evidence_std"])
        assert abs(own["log_evidence"] - other["log_evidence"]) < 4 * error
    if "rows" in recorded:
        header, (rows, expected) = (
            recorded["header"], (np.array(each["rows"]) for each in (found, recorded))
        )  # fmt: skip
        for channel in ("x", "z", "phi", "F_x", "F_z", "tau"):
            mean, sd = header.index(f"{channel}_mean"), header.index(f"{channel}_sd")
            off = np.abs(rows[:, mean] - expected[:, mean]) / expected[:, sd]
            assert np.nanmax(off) < 0.5, channel
    if "verdict" in recorded:
        # The outline's latents have several modes, of which seeds weigh one or the other more.
        own, other = found["verdict"], recorded["verdict"]
        assert own["verdict"] == other["verdict"]
        for effect, expected in zip(own["effects"], other["effects"], strict=True):
            assert effect["name"] == expected["name"]
            for one, before in zip(effect["parameters"], expected["parameters"], strict=True):
                assert abs(one["value"] - before["value"]) < 0.5 * before["sd"]


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in RUNS]
)
def test_runs_give_what_was_recorded(name: str, tmp_path: Path) -> None:
    assert (EPISODES / "mug.csv").is_file()
    recorded = json.loads((HERE / "runs" / f"{name}.json").read_text(encoding="utf-8"))
    found = figures_of(CHECKOUT, name, tmp_path)
    if name in EXACT:
        same(found, recorded, name)
    else:
        alike(found, recorded)
