"""Effects on how the wrench is read."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from tpcd.effects.conditions import Conditions, Outcome, Rows
from tpcd.effects.declare import DeclaredEffect, column
from tpcd.effects.protocol import EffectParameter

_FORCE = (-3.0, 3.0)
_TORQUE = (-0.3, 0.3)


def _read_by(conditions: Conditions, matrix: Tensor) -> Conditions:
    """The readings put through one more matrix (m, 3, 3)."""
    return replace(
        conditions,
        sensor=matrix[:, None] @ conditions.sensor,
        bias=(matrix[:, None] @ conditions.bias[..., None])[..., 0],
    )


def _bias(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    return replace(conditions, bias=conditions.bias + values[:, None])


def _drift(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    force = torch.cat((values, torch.zeros_like(values[:, :1])), dim=-1)
    return replace(conditions, bias=conditions.bias + force[:, None] * rows.share[:, None])


def _gain(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    return _read_by(conditions, _identity(values) * (1.0 + column(values, 0)[..., None]))


def _rotation(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    matrix = _identity(values)
    cosine, sine = values[:, 0].cos(), values[:, 0].sin()
    matrix[:, 0, 0] = matrix[:, 1, 1] = cosine
    matrix[:, 0, 1], matrix[:, 1, 0] = 0.0 - sine, sine
    return _read_by(conditions, matrix)


def _reference_point(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    matrix = _identity(values)
    matrix[:, 2, 0], matrix[:, 2, 1] = values[:, 1], 0.0 - values[:, 0]
    return _read_by(conditions, matrix)


def _identity(values: Tensor) -> Tensor:
    return torch.eye(3, dtype=values.dtype).repeat(len(values), 1, 1)


def _length(name: str) -> EffectParameter:
    return EffectParameter(name, "m", -0.06, 0.06, shown_unit="mm", shown_factor=1e3)


SENSOR_EFFECTS = (
    DeclaredEffect(
        "force_bias",
        "sensor",
        (
            EffectParameter("F_x", "N", *_FORCE),
            EffectParameter("F_z", "N", *_FORCE),
            EffectParameter("tau", "N·m", *_TORQUE),
        ),
        _bias,
        "the wrench is read too high by {0}, {1} and {2}",
    ),
    DeclaredEffect(
        "force_drift",
        "sensor",
        (EffectParameter("F_x", "N", -4.0, 4.0), EffectParameter("F_z", "N", -4.0, 4.0)),
        _drift,
        "the forces that are read drift by {0} and {1} over the run",
    ),
    DeclaredEffect(
        "force_gain",
        "sensor",
        (EffectParameter("gain", "1", -0.4, 0.4, shown_unit="%", shown_factor=100.0),),
        _gain,
        "the wrench is read {0} too large",
        needs=("floor load", "wall load"),
    ),
    DeclaredEffect(
        "sensor_rotation",
        "sensor",
        (EffectParameter("angle", "rad", -0.3, 0.3, shown_unit="deg", shown_factor=57.29578),),
        _rotation,
        "the force sensor is turned by {0}",
        needs=("floor load", "wall load"),
    ),
    DeclaredEffect(
        "wrench_reference_point",
        "sensor",
        (_length("x"), _length("z")),
        _reference_point,
        "the torque is read about a point {0} and {1} from the end effector in x and z",
        needs=("floor load", "wall load"),
    ),
)
