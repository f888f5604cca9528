"""Identification of arms all of which is known: intervals that hold, and what cannot be told."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from tests.made_arm import Arm, moving, resting, truth
from tpcd.identification.identify import identify
from tpcd.identification.quantity import Quantity
from tpcd.logs.log import Log

SECONDS = 60.0
"""Of motion and contact in a recording: what a user records in one go [s]."""
LOADED = ("weight", "force_bias", "torque_bias", "centre_of_mass", "sensor_rotation")
SPRINGS = ("stiffness", "arm_friction")
MOVING = {
    "sensor turned, off the origin": Arm(
        sensor_rotation=(0.05, -0.03, 0.08), point=(0.0, 0.02, 0.05)
    ),
    "world axes, inverted": Arm(frame="world", sign=-1.0),
    "gain 1.2, stiffness given": Arm(gain=1.2),
    "six times the friction, five the noise": Arm(
        friction=(3.0, 2.4, 3.6, 0.3, 0.24, 0.36), force_std=1.0, torque_std=0.05
    ),
}
RESTING = "rests in seven orientations"


def _unpressed(seed: int) -> Log:
    log = moving(Arm(), seed, SECONDS)
    noise = np.random.default_rng(seed).standard_normal(log.forces.shape)
    return replace(log, forces=0.2 * noise, torques=0.01 * noise)


def _without_commands(seed: int) -> Log:
    return replace(moving(Arm(), seed, SECONDS), command_positions=None, command_rotations=None)


UNTOLD: dict[str, tuple[Callable[[int], Log], tuple[str, ...]]] = {
    "never pressed": (_unpressed, (*SPRINGS, "wrench_sign")),
    "turns by a degree": (
        lambda seed: moving(Arm(turn=0.005), seed, SECONDS),
        ("wrench_frame", "stiffness_frame"),
    ),
    "rests in one orientation": (lambda seed: resting(Arm(), seed, 6, tilt=0.0), LOADED),
    "no set points": (_without_commands, (*SPRINGS, "pose_lag", "wrench_lag")),
}
"""Recordings, and what they cannot tell."""


def identify_runs(seed: int) -> list[dict[str, Any]]:
    """Every quantity of one recording of each kind."""
    rows = []
    for case, arm in MOVING.items():
        given = arm.stiffness if arm.gain != 1.0 else None
        known = truth(arm) | ({f"gain_{a}": arm.gain for a in "xyz"} if given else {})
        rows += _compared(case, identify(moving(arm, seed, SECONDS), given), known)
    arm = Arm(sensor_rotation=(0.05, -0.1, 0.2))
    known = {name: value for name, value in truth(arm).items() if name.startswith(LOADED)}
    rows += _compared(RESTING, identify(resting(arm, seed, 7, crosstalk=0.1)), known)
    for case, (make, names) in UNTOLD.items():
        for each in identify(make(seed)):
            if each.name.startswith(names):
                rows.append({"table": "untold", "of": [case], "told": each.told})
    return rows


def _compared(case: str, told: Iterable[Quantity], known: dict[str, float]) -> list[dict[str, Any]]:
    rows = []
    for each in told:
        if each.name not in known:
            continue
        row = {"of": [case, _kind(each)], "name": each.name, "told": each.told}
        if each.interval is not None:
            low, high = each.interval
            row |= {"held": low <= known[each.name] <= high, "size": (high - low) / 2}
        rows.append(row)
    return rows


def _kind(told: Quantity) -> str:
    """A quantity without its axis; its unit tells what is along axes from what is about them."""
    kind = re.sub("_r?[xyz]$", "", told.name).replace("_", " ")
    return f"{kind} [{told.unit}]" if told.unit else kind
