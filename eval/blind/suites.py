"""Which cases the benchmark has: suites of hidden effects, their sizes and the data they leave.

A label says what is hidden (`clean`, an effect, `pair`); suites differ in the size, the motion,
the noise and the physics behind the data. Cases of one label and run share their world, so that
suites can be compared in pairs. Nothing heavy is imported here.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

CLEAN, PAIR = "clean", "pair"
Sizes = dict[str, dict[str, float]]

MEDIUM: Sizes = {
    "floor_compliance": {"compliance": 2.5e-4},
    "wall_compliance": {"compliance": 2.5e-4},
    "tangential_compliance": {"compliance": 2.5e-4},
    "adhesion": {"force": 1.0},
    "wall_friction": {"log_ratio": math.log(0.55)},
    "directional_friction": {"log_ratio": 0.3},
    "static_kinetic": {"ratio": 1.3},
    "load_friction": {"exponent": -0.3},
    "floor_tilt": {"angle": math.radians(1.4)},
    "wall_tilt": {"angle": math.radians(2.9)},
    "floor_curvature": {"curvature": 1.0},
    "grasp_compliance": {"compliance": math.radians(5.7)},
    "grasp_slip": {"angle": math.radians(1.7), "at": 0.5},
    "floor_drift": {"drift": 3e-3},
    "command_lag": {"share": 0.1},
    "stiffness_error": {"log_ratio_x": math.log(1.10), "log_ratio_z": math.log(0.92)},
    "arm_friction": {"force": 0.3},
    "payload": {"weight": 1.0, "lever": 0.03},
    "force_bias": {"F_x": 0.6, "F_z": -0.9, "tau": 0.03},
    "force_drift": {"F_x": 1.0, "F_z": -1.2},
    "force_gain": {"gain": 0.08},
    "sensor_rotation": {"angle": math.radians(4.6)},
    "wrench_reference_point": {"x": 0.02, "z": -0.01},
}
"""Every effect of the catalogue at its medium size, SI units."""
OUTSIDE: Sizes = {
    "floor_step": {"height": 3e-3, "x": 0.05},
    "friction_field": {"slope": 6.0},
    "floor_ripple": {"height": 1.5e-3, "length": 0.06, "skew": 0.25},
    "floor_bump": {"height": 3e-3, "x": 0.05, "skew": 0.4},
}
"""Effects that the catalogue does not have, and of which no formula has quite the form; MuJoCo
alone can be given them."""
PLACES = frozenset(
    {
        ("payload", "lever"),
        ("floor_step", "x"),
        ("floor_ripple", "length"),
        ("floor_ripple", "skew"),
        ("floor_bump", "x"),
        ("floor_bump", "skew"),
        ("grasp_slip", "at"),
    }
)
"""Parameters that say where, when or of which form: the same for small effects."""
RANGES = {("grasp_slip", "at"): (0.3, 0.7)}
"""Parameters that are drawn from a range instead of around a size."""
SMALL = 0.35
"""Small effects are this share of the medium ones."""
EFFECTS = tuple(MEDIUM)


@dataclass(frozen=True)
class Suite:
    """What the cases of a suite have in common."""

    labels: tuple[str, ...]
    scale: float = 1.0
    """Size of the effects relative to medium."""
    steps: int = 60
    policy: Literal["diagnosis", "press_and_slide"] = "diagnosis"
    noise: float = 1.0
    """Sensor noise relative to the usual one."""
    truth: Literal["quasistatic", "mujoco"] = "quasistatic"
    without: str = ""
    """The part of the workflow that is switched off."""


SUITES = {
    "clean": Suite((CLEAN,)),
    "medium": Suite(EFFECTS),
    "small": Suite(EFFECTS, scale=SMALL),
    "pairs": Suite((PAIR,)),
    "outside": Suite(tuple(OUTSIDE), truth="mujoco"),
    "press": Suite(EFFECTS, policy="press_and_slide"),
    "short30": Suite(EFFECTS, steps=30),
    "short15": Suite(EFFECTS, steps=15),
    "noise3": Suite(EFFECTS, noise=3.0),
    "mujoco": Suite((CLEAN, *EFFECTS), truth="mujoco"),
    "no_base_refit": Suite((CLEAN, *EFFECTS), without="base_refit"),
    "no_from_prior": Suite((CLEAN, *EFFECTS), without="from_prior"),
    "no_adequacy": Suite((CLEAN, *EFFECTS), without="adequacy"),
    "no_parity": Suite((CLEAN, *EFFECTS), without="parity"),
    "quick": Suite((CLEAN, "force_bias", "floor_compliance"), steps=20),
}


@dataclass(frozen=True)
class Case:
    """What to hide, and from which data it is to be found."""

    suite: str
    label: str
    run: int

    @property
    def settings(self) -> Suite:
        """Those of its suite."""
        return SUITES[self.suite]

    def token(self, seed: int) -> str:
        """A name for its files that says nothing of what is in them."""
        text = f"{seed}/{self.suite}/{self.label}/{self.run}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def plan(suites: Sequence[str], runs: int) -> list[Case]:
    """All cases, one run of all labels after another, so that a stopped suite is balanced."""
    return [
        Case(suite, label, run)
        for suite in suites
        for run in range(runs)
        for label in SUITES[suite].labels
    ]
