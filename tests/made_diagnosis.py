"""A diagnosis in plain values, made without a fit, for tests of what is written of it."""

from __future__ import annotations

import math

from tpcd.discrepancy.diagnosis import (
    Candidate,
    Cell,
    Diagnosis,
    Estimate,
    Gap,
    Limit,
    NamedEffect,
)
from tpcd.effects.excitations import NEEDED


def a_gap(contact: str, rows: int) -> Gap:
    """Of z, closed."""
    before, after = (4e-4, 3e-4, 5e-4), (2e-4, 1.8e-4, 2.4e-4)
    return Gap("z", "m", contact, rows, *before, *after, 2e-4, 1.0, 0.9, 1.0)


def a_diagnosis() -> Diagnosis:
    """A soft floor, named."""
    size = Estimate("compliance", 2e-4, 1e-5, 1.8e-4, 2.2e-4, "m/N", "2.00 ± 0.10 mm per 10 N")
    cells = tuple(Cell("floor, stick", channel, "mean", 1.5, 9) for channel in ("x", "z", "phi"))
    return Diagnosis(
        "named",
        "the floor yields 2.00 ± 0.10 mm per 10 N",
        effects=(NamedEffect("floor_compliance", (size,), "the floor yields"),),
        candidates=(
            Candidate("floor_compliance", 1, 30.0, (1.0, 2.0), "accepted: gain 30.0"),
            Candidate("adhesion", 1, -math.inf),
        ),
        log_evidence_base=120.0,
        log_evidence_base_by_seed=(120.1, 119.9),
        log_evidence=150.0,
        log_evidence_by_seed=(150.5, 149.2, 150.1),
        gap=(a_gap("all", 50),),
        gap_by_contact=(a_gap("floor and wall", 7),),
        share_closed=0.95,
        share_closed_low=0.9,
        share_closed_high=0.99,
        share_closed_typical=0.5,
        held_out="fresh episodes",
        cells_before=cells,
        cells_after=cells,
        unexplained_before=0.1,
        unexplained_after=0.0,
        theta_before=(Estimate("friction", 0.3, 0.01, 0.28, 0.32, "1"),),
        theta_after=(Estimate("friction", 0.32, 0.02, 0.29, 0.35, "1"),),
        detection_limits=(Limit("adhesion", "force", math.inf, "none", "needs lift-off"),),
        coverage=dict.fromkeys(NEEDED, 1.0),
        tests={"parity": 1.44, "parity_p": 1e-4, "free_space": 0.81, "free_space_p": 0.6},
    )
