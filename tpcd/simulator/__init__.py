"""The quasi-static simulator f_theta(x, u) and its records."""

from tpcd.simulator.record import (
    ContactMode,
    StepSettings,
    StepStatus,
    Transition,
)
from tpcd.simulator.step import rollout, simulate_step
from tpcd.simulator.truth import QuasistaticTruth

__all__ = [
    "ContactMode",
    "QuasistaticTruth",
    "StepSettings",
    "StepStatus",
    "Transition",
    "rollout",
    "simulate_step",
]
