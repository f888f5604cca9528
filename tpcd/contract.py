"""The contract of the doors in Python: which numbers are taken, in which units, and what is said of
others.

Tensors, arrays and lists of numbers are taken; whole numbers become float64. What has another shape
or device, or no numbers, is refused before anything is computed. So is what looks like another unit
(millimetres, degrees, N/mm), unless the caller insists with `unusual=True`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.parameters import LARGEST_FRICTION

LARGEST_LENGTH = 5.0
"""Lengths beyond this [m] are taken for millimetres: no arm reaches so far."""
LARGEST_ANGLE = 2 * math.pi
"""Angles beyond this [rad] are taken for degrees."""
COUNTED = "degrees, or turns that are counted on (wrap them to within pi)"
"""What larger angles look like."""
LEAST_STIFFNESS, LARGEST_STIFFNESS = 10.0, 1e6
"""Springs of an arm [N/m]. Softer ones are taken for N/mm, in which arms have 0.03 to 5; no arm is
stiffer."""
LARGEST_NOISE = {"x": (0.05, "m", "mm"), "z": (0.05, "m", "mm"), "phi": (0.5, "rad", "degrees")}
"""Noise of poses beyond this [m, rad] is taken for millimetres or degrees."""
SENSOR_NAMES = ("x", "z", "phi", "F_x", "F_z", "tau")
"""Channels of a recorded row, in the order of their noise."""
LARGEST_TURNING_STIFFNESS = 1e4
"""The same about its axis [N·m/rad]; stiffer ones are taken for N·mm/rad."""
LARGEST_AMOUNTS = {
    "m": (0.1, "millimetres"),
    "rad": (1.0, "degrees"),
    "N": (500.0, "millinewtons"),
    "N·m": (50.0, "N·mm"),
    "m/N": (0.01, "mm/N"),
    "rad/(N·m)": (3.0, "degrees/(N·m)"),
    "1/m": (200.0, "another unit"),
    "1": (10.0, "percent"),
}
"""Sizes of effects beyond which they are taken for another unit; a terrain that yields by 0.01 m/N
is as soft as a soft arm."""
PLACES = ("x", "z", "place", "lever", "length", "width")
"""Parameters of effects in metres that are no sizes but places: at most `LARGEST_LENGTH`."""
INSIST = "or insist with unusual=True (in a YAML unusual: true, in an import --unusual)"


def as_numbers(
    name: str, value: Any, last: int, axes: int | None = None, device: torch.device | None = None
) -> Float[Tensor, "*batch n"]:
    """A floating tensor of `value`, with `last` numbers on its last axis.

    `axes` is the most axes it may have; one that is missing comes first, with length 1. Raises
    TypeError for what is no real numbers, ValueError for another shape or device.
    """
    expected = f"expected {'rows of ' if axes == 2 else ''}{last} numbers"
    if isinstance(value, Tensor):
        found = value
    else:
        try:
            found = torch.from_numpy(np.array(value, dtype=None))
        except (TypeError, ValueError) as error:
            told = type(value).__name__ if value is None or isinstance(value, str) else repr(value)
            raise TypeError(f"{name} is {told[:60]}, {expected}") from error
    if found.dtype == torch.bool or found.is_complex():
        raise TypeError(f"{name} holds {str(found.dtype).removeprefix('torch.')}, {expected}")
    if found.ndim == 0 or found.shape[-1] != last or (axes and found.ndim > axes):
        raise ValueError(f"{name} has shape {tuple(found.shape)}, {expected}")
    if device is not None and found.device != device:
        raise ValueError(f"{name} is on {found.device}, expected it on {device} as the rest is")
    if axes and found.ndim < axes:
        found = found.reshape(*[1] * (axes - found.ndim), *found.shape)
    return found if found.is_floating_point() else found.double()


def one_batch(shapes: dict[str, torch.Size]) -> torch.Size:
    """The batch that named leading axes broadcast to. Raises ValueError."""
    try:
        return torch.broadcast_shapes(*shapes.values())
    except RuntimeError as error:
        told = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items() if shape)
        raise ValueError(f"batch axes are {told}, expected axes that broadcast") from error


def check_finite(name: str, value: Float[Tensor, "*batch n"]) -> None:
    """Refuse a NaN or an infinity; names the row. Raises ValueError."""
    bad = ~torch.isfinite(value)
    if bool(bad.any()):
        place = torch.nonzero(bad)[0].tolist()
        where = f" at {place}" if value.ndim > 1 else ""
        raise ValueError(f"{name} is {float(value[tuple(place)])}{where}, expected a finite number")


def check_lengths(name: str, value: Float[Tensor, "*values"], unusual: bool = False) -> None:
    """Refuse lengths that are no metres; ValueError."""
    _check_largest(name, value, LARGEST_LENGTH, "m", "millimetres", unusual)


def check_pose(name: str, value: Float[Tensor, "*batch 3"], unusual: bool = False) -> None:
    """Refuse poses or commands (x, z, angle) that are no metres and radians; ValueError."""
    check_lengths(name, value[..., :2], unusual)
    _check_largest(name, value[..., 2], LARGEST_ANGLE, "rad", COUNTED, unusual)


def check_noise(name: str, std: Float[Tensor, " c"], unusual: bool = False) -> None:
    """Refuse standard deviations of the first channels of a row (x, z, phi, ...) that are negative
    or not finite or that, unless `unusual`, look like another unit; ValueError names the channel.
    """
    check_finite(name, std)
    for channel, value in zip(SENSOR_NAMES, std.tolist(), strict=False):
        largest, unit, likely = LARGEST_NOISE.get(channel, (math.inf, "", ""))
        if value < 0:
            raise ValueError(f"{name} of {channel} is {value:g}, expected >= 0")
        if value > largest and not unusual:
            raise ValueError(
                f"{name} of {channel} is {value:g}, expected {unit} (at most {largest:g}); it looks"
                f" like {likely}: give it in {unit}"
            )


def _check_largest(
    name: str, value: Tensor, limit: float, unit: str, likely: str, unusual: bool
) -> None:
    if unusual or value.numel() == 0:
        return
    reached = float(value.detach().abs().nan_to_num(0.0, 0.0, 0.0).max())
    if reached > limit:
        raise ValueError(
            f"{name} reaches {reached:g}, expected {unit} (at most {limit:.3g}): it looks like"
            f" {likely}; convert it, {INSIST}"
        )


def check_effect(name: str, parameter: str, value: float, unit: str) -> None:
    """Refuse a parameter of an effect that is not finite, or looks like another unit;
    ValueError."""
    limit, likely = LARGEST_AMOUNTS.get(unit, (math.inf, ""))
    if unit == "m" and parameter in PLACES:
        limit = LARGEST_LENGTH
    if not math.isfinite(value):
        raise ValueError(f"{name}.{parameter} is {value}, expected a finite number")
    if abs(value) > limit:
        shown = "a plain number" if unit == "1" else unit
        raise ValueError(
            f"{name}.{parameter} is {value:g}, expected {shown} (at most {limit:g}): it looks like"
            f" {likely}; convert it"
        )


def check_prior(name: str, bounds: Any, unit: str, unusual: bool = False) -> None:
    """Refuse a range [low, high] that no scene parameter has or that, unless `unusual`, looks like
    another unit; ValueError, of what is wrong and what to do."""
    low, high = (float(bound) for bound in as_numbers(f"prior of {name}", bounds, 2, axes=1))
    told = f"prior of {name} is [{low:g}, {high:g}], "
    if not -math.inf < low < high < math.inf:
        remedy = "swap them, or give a narrow range around a known value"
        raise ValueError(f"{told}expected finite low < high; {remedy}")
    largest, likely = (LARGEST_ANGLE, "degrees") if unit == "rad" else (LARGEST_LENGTH, "mm")
    if unit != "1" and max(abs(low), abs(high)) > largest and not unusual:
        raise ValueError(f"{told}which looks like {likely}; give it in {unit}")
    if (low < 0 and name == "friction") or (low <= 0 and name == "scale"):
        raise ValueError(f"{told}expected a positive range; raise low")
    if name == "friction" and high > LARGEST_FRICTION:
        limit = f"{LARGEST_FRICTION:g}"
        raise ValueError(f"{told}expected at most {limit}; nothing slips from there on")


def check_stiffness(
    value: Float[Tensor, "*batch 3"], unusual: bool = False, insist: str = f", {INSIST}"
) -> None:
    """Refuse stiffness along x, z [N/m] and about y [N·m/rad] that is not positive and finite, or
    that looks like N/mm or N·mm/rad; ValueError, which says how to `insist`."""
    right = (value > 0) & torch.isfinite(value)
    if not bool(right.all()):
        raise ValueError(f"stiffness is {value.tolist()}, expected three positive finite numbers")
    if unusual or value.numel() == 0:
        return
    with torch.no_grad():
        each = value.reshape(-1, 3)
        least, largest = float(each[:, :2].min()), float(each[:, :2].max())
        turning = float(each[:, 2].max())
    if least < LEAST_STIFFNESS:
        fault = f"{least:g}, expected N/m ({LEAST_STIFFNESS:g} or more): it looks like N/mm"
    elif largest > LARGEST_STIFFNESS:
        fault = f"{largest:g}, expected N/m (at most {LARGEST_STIFFNESS:g})"
    elif turning > LARGEST_TURNING_STIFFNESS:
        limit = LARGEST_TURNING_STIFFNESS
        fault = f"{turning:g}, expected N·m/rad (at most {limit:g}): it looks like N·mm/rad"
    else:
        return
    raise ValueError(f"stiffness is {fault}; convert it{insist}")
