"""Names and parameters of the effects that a MuJoCo truth can be given, and wrong sensors.

`hidden` maps the name of an effect to its parameters in SI units. What an effect leaves
out is at its null value, and an effect whose sizes are all null is as if it were absent.
World axes x to the right, z up, phi from x towards z.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

Hidden = Mapping[str, Mapping[str, float | int]]
Effects = dict[str, dict[str, float]]


@dataclass(frozen=True)
class EffectForm:
    """Which parameters an effect has."""

    sizes: tuple[str, ...]
    """Parameters that make the effect; it is absent where all are null."""
    places: tuple[str, ...] = ()
    """Parameters that say where or when it acts, zero unless given."""
    null: float = 0.0
    """Value of a size at which nothing happens."""
    least: float = -math.inf
    """Least value of a size that has a meaning."""


COMPLIANCE = EffectForm(("compliance",), least=0.0)
LOG_RATIO = EffectForm(("log_ratio",))
ANGLE = EffectForm(("angle",))
FORCE = EffectForm(("force",), least=0.0)

FORMS = {
    "floor_compliance": COMPLIANCE,
    "wall_compliance": COMPLIANCE,
    "tangential_compliance": COMPLIANCE,
    "grasp_compliance": COMPLIANCE,
    "floor_tilt": ANGLE,
    "wall_tilt": ANGLE,
    "floor_curvature": EffectForm(("curvature",)),
    "floor_step": EffectForm(("height",), ("x",)),
    "floor_ripple": EffectForm(("height",), ("length", "skew")),
    "floor_bump": EffectForm(("height",), ("x", "skew")),
    "floor_drift": EffectForm(("drift",)),
    "wall_friction": LOG_RATIO,
    "directional_friction": LOG_RATIO,
    "static_kinetic": EffectForm(("ratio",), null=1.0, least=1.0),
    "load_friction": EffectForm(("exponent",)),
    "friction_field": EffectForm(("slope",)),
    "adhesion": FORCE,
    "stiffness_error": EffectForm(("log_ratio_x", "log_ratio_z")),
    "payload": EffectForm(("weight",), ("lever",)),
    "command_lag": EffectForm(("share",)),
    "arm_friction": FORCE,
    "grasp_slip": EffectForm(("angle", "shift"), ("at",)),
    "force_bias": EffectForm(("F_x", "F_z", "tau")),
    "force_drift": EffectForm(("F_x", "F_z")),
    "force_gain": EffectForm(("gain",)),
    "sensor_rotation": ANGLE,
    "wrench_reference_point": EffectForm(("x", "z")),
}
"""Every effect by name, with the parameters that `hidden` may give it."""

WORLD_EFFECTS = frozenset(FORMS) - {
    "stiffness_error", "command_lag",
    "force_bias", "force_drift", "force_gain", "sensor_rotation", "wrench_reference_point",
}  # fmt: skip
"""Effects that need more in the model than other numbers in the undisturbed one."""


@dataclass(frozen=True)
class ActiveEffects:
    """The effects that do something, with every parameter filled in."""

    values: Effects = field(default_factory=dict)

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def get(self, name: str, parameter: str) -> float:
        """A parameter, at its null value if the effect is absent."""
        form = FORMS[name]
        null = form.null if parameter in form.sizes else 0.0
        return self.values.get(name, {}).get(parameter, null)


def active_effects(hidden: Hidden) -> ActiveEffects:
    """Check names and values; raises `ValueError` for what is unknown or has no meaning."""
    active: Effects = {}
    for name, given in hidden.items():
        if name not in FORMS:
            raise ValueError(f"unknown effect {name!r}, known are {', '.join(FORMS)}")
        form = FORMS[name]
        for parameter, value in given.items():
            if parameter not in (*form.sizes, *form.places):
                raise ValueError(
                    f"effect {name} has no parameter {parameter!r},"
                    f" expected {', '.join((*form.sizes, *form.places))}"
                )
            least = form.least if parameter in form.sizes else -math.inf
            if not math.isfinite(value) or value < least:
                raise ValueError(f"{parameter} of {name} is {value}, expected finite, >= {least:g}")
        full = {**dict.fromkeys(form.sizes, form.null), **dict.fromkeys(form.places, 0.0), **given}
        if any(full[size] != form.null for size in form.sizes):
            active[name] = {parameter: float(value) for parameter, value in full.items()}
    return ActiveEffects(active)


def sensor_effects(
    hidden: Hidden, pose: Float[Tensor, " 3"], wrench: Float[Tensor, " 3"], share: float
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """Pose [m, m, rad] and wrench [N, N, N·m] as a wrong sensor reports them, without noise.

    `share` is row / steps of the episode, in [0, 1]. The sensor has its own reference
    point (torque less x F_z - z F_x), is turned (the force alone, counter-clockwise), then
    amplifies all three channels, and its zero is off and drifts: in this order, which only
    matters where several are combined. Raises `ValueError` for unknown effects.
    """
    effects = active_effects(hidden)
    force_x, force_z, torque = wrench.tolist()
    point_x, point_z = (effects.get("wrench_reference_point", axis) for axis in ("x", "z"))
    torque -= point_x * force_z - point_z * force_x
    angle = effects.get("sensor_rotation", "angle")
    cosine, sine = math.cos(angle), math.sin(angle)
    force_x, force_z = cosine * force_x - sine * force_z, sine * force_x + cosine * force_z
    gain = 1.0 + effects.get("force_gain", "gain")
    reported = [
        gain * force_x
        + effects.get("force_bias", "F_x")
        + share * effects.get("force_drift", "F_x"),
        gain * force_z
        + effects.get("force_bias", "F_z")
        + share * effects.get("force_drift", "F_z"),
        gain * torque + effects.get("force_bias", "tau"),
    ]
    return pose.clone(), torch.tensor(reported, dtype=wrench.dtype)
