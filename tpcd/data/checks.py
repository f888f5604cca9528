"""What the rows of an episode must obey, and what merely looks odd about them.

`check_rows` refuses rows that cannot be data in the agreed units, and `check_units` wrenches that
are not those of the stiffness; `check_episode` returns sentences on what is possible but
suspicious. Rows are counted from 0, the free start pose.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tpcd.contract import SENSOR_NAMES
from tpcd.data.doubts import doubts_told
from tpcd.data.equilibrium import Rows, departure, misplaced
from tpcd.data.limits import (
    COMMAND_COLUMNS,
    POSE_COLUMNS,
    WRENCH_COLUMNS,
    check_columns,
    check_jumps,
)
from tpcd.data.noise import noise_findings
from tpcd.data.same_rows import copied_rows
from tpcd.data.table import row_name
from tpcd.errors import EpisodeError
from tpcd.quality.episode_rows import check_repeats
from tpcd.quality.finding import Finding, Weight
from tpcd.quality.lever import depth_of_contact

if TYPE_CHECKING:
    from tpcd.data.episode import Episode

NOISE_FACTOR = 6.0
"""Differences beyond this many standard deviations are not noise (1 in 5e8 for a normal)."""
ROUNDING = 1e-6
"""Start pose and command may differ by this much [m, rad] on top of noise: printed digits."""
NO_CONTACT = "no step shows contact beyond the noise: it tells only where nothing is"
FREE_OF_NOISE = "taken as free of noise"
INVERTED = -0.3
"""A wrench that is less than this many times K (pose - command) has the opposite sign."""
ANOTHER_ORDER = 5.0
"""Forces that are larger or smaller than K (pose - command) by this factor are in other units."""
LEAST_FELT = 2
"""So many rows beyond the noise are no bad reading any more."""
UNIT_LEFT = 0.5
"""Forces are in another unit where that leaves less than this part of them."""
SIDE = 5.0
"""Standard errors from which on it is known from which side forces act (see `lever`)."""
LEAST_ROWS = 3
"""Rows beyond the noise that tell in which units an episode is."""
FREE_WRENCH = 1e-3
"""The start wrench may differ from 0 by this much [N, N·m] on top of noise: printed digits."""


def check_steps(path: Path, steps: np.ndarray) -> None:
    """Steps must be 0, 1, 2, … without gaps; at least a start row and one step."""
    if len(steps) == 0:
        raise EpisodeError(path, "no rows below the header", "record a start pose and steps")
    for row, step in enumerate(steps):
        if step == row:
            continue
        where = f"{row_name(row, path)}, column step: found {step:g}, expected {row}"
        if row and step == steps[row - 1]:
            problem, remedy = f"{where} (repeated)", "keep one row for each step"
        elif row and step < steps[row - 1]:
            problem, remedy = f"{where} (steps go backwards)", "sort the rows by step"
        elif row in steps[row:]:
            problem, remedy = f"{where} (steps out of order)", "sort the rows by step"
        elif not float(step).is_integer():
            problem, remedy = f"{where} (not a whole number)", "number the rows 0, 1, 2, …"
        elif row:
            problem, remedy = f"{where} (rows missing)", "restore them or split the episode there"
        else:
            problem, remedy = where, "row 0 is the free start pose; number the rows 0, 1, 2, …"
        raise EpisodeError(path, problem, remedy)
    if len(steps) < 2:
        raise EpisodeError(path, "only the start row, no step", "record at least one step")


def check_rows(
    path: Path,
    commands: np.ndarray,
    poses: np.ndarray,
    wrenches: np.ndarray,
    sensor_std: np.ndarray,
    stiffness: np.ndarray,
    unusual: bool = False,
) -> None:
    """Refuse rows (n, 3) that are not finite, not SI, jump, or do not start at rest and free.

    Raises `EpisodeError` naming row and column.
    """
    check_columns(path, commands, poses, wrenches, unusual)
    check_jumps(path, commands, poses, wrenches, stiffness)
    try:
        _check_start(path, commands[0], poses[0], wrenches[0], sensor_std)
    except EpisodeError:
        told = misplaced((commands, poses, wrenches), stiffness, sensor_std)
        if told is not None:
            raise EpisodeError(path, *told) from None
        raise


def _check_start(
    path: Path,
    command: np.ndarray,
    pose: np.ndarray,
    wrench: np.ndarray,
    sensor_std: np.ndarray,
) -> None:
    """Row 0 is at rest and free: the command is the pose, the wrench is noise."""
    offset = np.abs(command - pose)
    offset[2] = abs(math.remainder(offset[2], 2 * math.pi))
    allowed = NOISE_FACTOR * sensor_std[:3] + ROUNDING
    for axis in np.flatnonzero(offset > allowed):
        raise EpisodeError(
            path,
            f"{row_name(0, path)}, column {COMMAND_COLUMNS[axis]}: found {command[axis]:.6g},"
            f" expected the start pose {POSE_COLUMNS[axis]} = {pose[axis]:.6g}"
            f" within {allowed[axis]:.2g}",
            "start free of contact and set command 0 to the measured pose, or correct sensor_std"
            f" ({sensor_std[axis]:.2g} here)",
        )
    noise = NOISE_FACTOR * sensor_std[3:] + FREE_WRENCH
    for axis in np.flatnonzero(np.abs(wrench) > noise):
        raise EpisodeError(
            path,
            f"{row_name(0, path)}, column {WRENCH_COLUMNS[axis]}: found {wrench[axis]:.4g} at the"
            f" start pose, expected 0 within {noise[axis]:.2g}",
            "start free of contact and zero the sensor there, or correct sensor_std"
            f" ({sensor_std[3 + axis]:.2g} here)",
        )


def check_episode(episode: Episode, effects: bool = False) -> list[str]:
    """Sentences on what is suspicious in an episode that obeys the format; often none.

    What it was accepted in spite of comes first, in one line. A wrench that is not K (pose -
    command) is told once, and unless a model has `effects` that may explain it.
    """
    told = doubts_told(episode.doubts, episode.path)
    found = [*episode_findings(episode), *noise_findings(episode)]
    departs = None
    if not effects and not any(each.kind in ("unit", "inverted", "wrench") for each in found):
        departs = departure(_rows(episode), episode.stiffness.numpy(), episode.sensor_std.numpy())
    lines = [str(each) for each in found] + (["; ".join(departs)] if departs else [])
    return [*([told] if told else []), *lines]


def episode_findings(episode: Episode) -> list[Finding]:
    """What speaks against the rows of an episode that obeys the format.

    In equilibrium the wrench is K (pose - command); rows whose wrench has the opposite
    sign or another size speak for a sign or unit error of the sensor or of the stiffness.
    """
    found = []
    noise, largest_wrench = episode.sensor_std.numpy(), np.abs(episode.wrenches.numpy()).max(0)
    significant, felt = _beyond_noise(episode)
    unit, order = _unit_of_forces(episode), _wrong_order(episode)
    if unit is not None:
        found.append(_serious("unit", *unit))
    elif order is not None:
        found.append(_serious("wrench", *order))
    slopes = wrench_slopes(episode)
    for axis, (name, slope) in enumerate(slopes.items()):
        if order is not None or (unit is not None and name != "tau"):
            continue
        if slope is None:
            if felt[:, axis].sum() >= LEAST_FELT:
                told = (
                    f"{name} reaches {largest_wrench[axis]:.3g} while K (pose - command) stays"
                    " within the noise; check the stiffness and the units"
                )
                found.append(Finding("wrench", Weight.DOUBT, told))
            continue
        if name == "tau" and slope < INVERTED and _right_forces(slopes):
            found.append(_serious("inverted", *turned_told(episode, slope)))
        elif slope < INVERTED:
            found.append(_serious("inverted", *inverted_told(episode, name, slope)))
        elif name == "tau" and _as_in_degrees(episode, slope):
            found.append(_serious("unit", *degrees_told(slope)))
        elif not 0.5 < slope < 2.0:
            told = (
                f"{name} is {slope:.2g} times K (pose - command), expected about 1; check the"
                " stiffness, the units and whether the arm had settled"
            )
            found.append(Finding("wrench", Weight.DOUBT, told))
    if not significant.any() and not (felt.sum(0) >= LEAST_FELT).any():
        found.append(Finding("contact", Weight.DOUBT, NO_CONTACT))
    found += [*repeated_readings(episode), *copied_rows(episode)]
    silent = [name for name, value in zip(SENSOR_NAMES, noise, strict=True) if value == 0]
    if silent:
        told = f"sensor_std of {', '.join(silent)} is 0: {FREE_OF_NOISE}"
        found.append(Finding("noise", Weight.NOTE, told))
    return found


def _serious(kind: str, sentence: str, remedy: str) -> Finding:
    return Finding(kind, Weight.SERIOUS, sentence, remedy=remedy)


def repeated_readings(episode: Episode) -> tuple[Finding, ...]:
    """Rows whose readings were repeated by a sensor that froze, or was at the end of its range."""
    return check_repeats(
        episode.commands.numpy(),
        episode.poses.numpy(),
        episode.wrenches.numpy(),
        episode.stiffness.numpy(),
        episode.sensor_std.numpy(),
    )


def check_units(episode: Episode) -> None:
    """Refuse an episode whose wrench is plainly not K (pose - command) in SI units.

    That is a force of the opposite sign or of another order of magnitude, or a torque as where
    angles are in degrees, in every way to measure it (`wrench_ratios`). Raises `EpisodeError`.
    """
    where = episode.path or "episode"
    check_scale(episode)
    for name, ratios in wrench_ratios(episode).items():
        if name == "tau":
            if all(_as_in_degrees(episode, ratio) for ratio in ratios):
                raise EpisodeError(where, *degrees_told(ratios[0]))
        elif all(ratio < INVERTED for ratio in ratios):
            raise EpisodeError(where, *inverted_told(episode, name, ratios[0]))
        elif min(map(abs, ratios)) > ANOTHER_ORDER or ANOTHER_ORDER * max(map(abs, ratios)) < 1:
            told = f"{name} is {ratios[0]:.2g} times K (pose - command), expected about 1"
            raise EpisodeError(where, told, "check the stiffness and the units")


def check_scale(episode: Episode) -> None:
    """Refuse an episode whose wrench is K (pose - command) but for a factor of 1000, or for rows or
    columns in another order; raises `EpisodeError` with what makes it so."""
    told = _unit_of_forces(episode) or _wrong_order(episode)
    if told is not None:
        raise EpisodeError(episode.path or "episode", *told)


def wrench_ratios(episode: Episode) -> dict[str, tuple[float, ...]]:
    """How many times K (pose - command) each channel of the wrench is, measured in four ways: by
    least squares, by least squares beside an offset and the other forces, by the median, and by
    size.

    None of them where few rows are beyond the noise in both. An arm that lags, friction in it,
    offsets that drift and a turned sensor change some of them, but hardly all.
    """
    significant, _ = _beyond_noise(episode)
    wrenches, expected = episode.wrenches.numpy(), _expected_wrenches(episode)
    felt = np.abs(wrenches) > NOISE_FACTOR * episode.sensor_std.numpy()[3:] + FREE_WRENCH
    design = np.column_stack((expected, np.ones(len(expected))))
    beside = np.linalg.lstsq(design, wrenches, rcond=None)[0]
    found: dict[str, tuple[float, ...]] = {}
    for axis, name in enumerate(WRENCH_COLUMNS):
        rows = significant[:, axis]
        there, here = wrenches[rows, axis], expected[rows, axis]
        if min(rows.sum(), felt[:, axis].sum()) >= LEAST_ROWS:
            slope = (there @ here) / (here @ here)
            size = np.copysign(np.sqrt((there @ there) / (here @ here)), slope)
            ways = (slope, beside[axis, axis], np.median(there / here), size)
            found[name] = tuple(map(float, ways))
    return found


def _unit_of_forces(episode: Episode) -> tuple[str, str] | None:
    """What is said of forces that are K (pose - command) but for a factor of 1000, and what to do;
    None where they are not."""
    forces, expected = episode.wrenches.numpy()[:, :2], _expected_wrenches(episode)[:, :2]
    limit = NOISE_FACTOR * episode.sensor_std.numpy()[3:5] + FREE_WRENCH
    rows = (np.abs(forces) > limit).any(1)
    if rows.sum() < LEAST_ROWS:
        return None
    forces, expected = forces[rows], expected[rows]
    size = np.linalg.norm(forces)
    if np.linalg.norm(forces - expected) < UNIT_LEFT * size:
        return None
    for factor, told, remedy in (
        (1e-3, "as where positions are in millimetres",
         "expected about 1; check the stiffness, or convert u_x, u_z, x and z to m"),
        (1e3, "as where the stiffness is in N/mm, or forces are in millinewtons",
         "expected about 1; give the stiffness in N/m and forces in N"),
    ):  # fmt: skip
        if np.linalg.norm(forces - factor * expected) < UNIT_LEFT * size:
            return f"forces are {factor:g} times K (pose - command), {told}", remedy
    return None


def _right_forces(slopes: dict[str, float | None]) -> bool:
    """Whether all forces that show anything have the right sign."""
    told = [slope for name, slope in slopes.items() if name != "tau" and slope is not None]
    return bool(told) and min(told) > 0


def turned_told(episode: Episode, slope: float) -> tuple[str, str]:
    """What is said of a torque that is inverted where forces are right: either it or the angle
    turns the other way, and from which side forces act may tell which."""
    wrenches = episode.wrenches.numpy()
    depth, error = depth_of_contact(
        wrenches, episode.poses.numpy()[:, 2], float(episode.sensor_std[5])
    )
    told = (
        f"tau is {slope:.2f} times K (phi - u_phi) while forces have the right sign, so either the"
        " angle or the torque looks inverted"
    )
    angle, torque = "change the sign of u_phi and phi", "change the sign of tau"
    if abs(depth) > SIDE * error:
        first, side = (torque, "within") if depth < 0 else (angle, "outside")
        told += f"; with tau as it is, forces act from {side} the object"
        return told, f"{first}, if phi does{'' if depth < 0 else ' not'} grow from x to z"
    return told, (
        f"look whether phi grows as the hand turns from x to z: if not, {angle}; else {torque}"
    )


def _as_in_degrees(episode: Episode, ratio: float) -> bool:
    """Whether the torque is about so many times K (phi - u_phi), and with angles in degrees all but
    noise."""
    significant, _ = _beyond_noise(episode)
    rows = significant[:, 2]
    there, here = episode.wrenches.numpy()[rows, 2], _expected_wrenches(episode)[rows, 2]
    left = np.linalg.norm(there - math.radians(1.0) * here)
    return 0.5 < math.degrees(ratio) < 2.0 and bool(left < UNIT_LEFT * np.linalg.norm(there))


def wrench_slopes(episode: Episode) -> dict[str, float | None]:
    """How many times K (pose - command) each channel of the wrench is, over the rows in which that
    is beyond the noise; None where there is none."""
    significant, _ = _beyond_noise(episode)
    wrenches, expected = episode.wrenches.numpy(), _expected_wrenches(episode)
    slopes: dict[str, float | None] = {}
    for axis, name in enumerate(WRENCH_COLUMNS):
        rows = significant[:, axis]
        there, here = wrenches[rows, axis], expected[rows, axis]
        slopes[name] = float((there @ here) / (here**2).sum()) if rows.any() else None
    return slopes


def degrees_told(ratio: float) -> tuple[str, str]:
    """What is said of a torque as where angles are in degrees, and what to do."""
    told = f"tau is {ratio:.2g} times K (phi - u_phi), as where angles are in degrees"
    return told, "expected rad: multiply u_phi, phi and its sensor_std by pi / 180"


def inverted_told(episode: Episode, name: str, slope: float) -> tuple[str, str]:
    """What is said of a force that looks inverted, and what to do: contact holds poses back, so
    where they move farther than their commands, the two are swapped."""
    axis = WRENCH_COLUMNS.index(name)
    told = f"it is {slope:.2f} times K (pose - command)"
    asked, moved = (
        float(values[:, axis].diff().abs().sum()) for values in (episode.commands, episode.poses)
    )
    if moved > asked + NOISE_FACTOR * len(episode) ** 0.5 * float(episode.sensor_std[axis]):
        u, x = COMMAND_COLUMNS[axis], POSE_COLUMNS[axis]
        return (
            f"{u} and {x} look swapped, or {name} inverted: {told}, and {x} moves by {moved:.2g} m"
            f" in all, farther than {u} with {asked:.2g} m, though contact holds poses back",
            f"swap the columns {u} and {x}, or change the sign of the column {name}",
        )
    return (
        f"{name} looks inverted: {told}; expected is"
        " what the world exerts on the object, so pressing on the floor gives F_z > 0",
        f"change the sign of the column {name}, or of its frame",
    )


def _wrong_order(episode: Episode) -> tuple[str, str] | None:
    return misplaced(_rows(episode), episode.stiffness.numpy(), episode.sensor_std.numpy())


def _rows(episode: Episode) -> Rows:
    return episode.commands.numpy(), episode.poses.numpy(), episode.wrenches.numpy()


def _expected_wrenches(episode: Episode) -> np.ndarray:
    deviations = (episode.poses - episode.commands).numpy()
    deviations[:, 2] = [math.remainder(angle, 2 * math.pi) for angle in deviations[:, 2]]
    return deviations * episode.stiffness.numpy()


def _beyond_noise(episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Entries (n, 3) of K (pose - command), and of the wrench, that are no noise."""
    noise = episode.sensor_std.numpy()
    limit = NOISE_FACTOR * np.hypot(noise[3:], episode.stiffness.numpy() * noise[:3]) + 1e-9
    return np.abs(_expected_wrenches(episode)) > limit, np.abs(episode.wrenches.numpy()) > limit
