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

from tpcd.data.header import LARGEST_LENGTH, SENSOR_NAMES
from tpcd.data.table import row_name
from tpcd.errors import EpisodeError
from tpcd.quality.episode_rows import check_repeats
from tpcd.quality.finding import Finding

if TYPE_CHECKING:
    from tpcd.data.episode import Episode

COMMAND_COLUMNS = ("u_x", "u_z", "u_phi")
POSE_COLUMNS = ("x", "z", "phi")
WRENCH_COLUMNS = ("F_x", "F_z", "tau")
LARGEST_JUMP = 0.5
"""Commands, or poses, of neighbouring rows further apart than this [m] are taken for an error."""
LARGEST_TURN = 2.0
"""The same of their angles [rad]."""
LARGEST_WRENCH = 1e4
"""Forces and torques beyond this [N, N·m] are taken for millinewtons or a fault."""
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
) -> None:
    """Refuse rows (n, 3) that are not finite, not SI, jump, or do not start at rest and free.

    Raises `EpisodeError` naming row and column.
    """
    length, angle = (LARGEST_LENGTH, "m", "millimetres"), (2 * math.pi, "rad", "degrees")
    force, torque = (LARGEST_WRENCH, "N", "millinewtons"), (LARGEST_WRENCH, "N·m", "mN·m")
    columns = (
        (COMMAND_COLUMNS, commands, (length, length, angle)),
        (POSE_COLUMNS, poses, (length, length, angle)),
        (WRENCH_COLUMNS, wrenches, (force, force, torque)),
    )
    for names, values, limits in columns:
        for axis, name in enumerate(names):
            _check_column(path, name, values[:, axis], limits[axis])
    _check_jumps(path, "command", COMMAND_COLUMNS, commands)
    _check_jumps(path, "pose", POSE_COLUMNS, poses)
    _check_start(path, commands[0], poses[0], wrenches[0], sensor_std)


def _check_jumps(path: Path, what: str, names: tuple[str, ...], values: np.ndarray) -> None:
    steps = np.diff(values, axis=0)
    turns = np.abs(np.remainder(steps[:, 2] + math.pi, 2 * math.pi) - math.pi)
    position, angle = f"columns {names[0]}, {names[1]}", f"column {names[2]}"
    lengths = np.linalg.norm(steps[:, :2], axis=1)
    frame, unit_of_angle = f"check the frame of the {what}s", f"check that {names[2]} is in rad"
    for columns, verb, sizes, largest, unit, remedy in (
        (position, "jumps", lengths, LARGEST_JUMP, "m", frame),
        (angle, "turns", turns, LARGEST_TURN, "rad", unit_of_angle),
    ):
        if not len(sizes) or sizes.max() <= largest:
            continue
        row = int(np.argmax(sizes > largest)) + 1
        raise EpisodeError(
            path,
            f"{row_name(row, path)}, {columns}: the {what} {verb} by {sizes[row - 1]:.3g} {unit},"
            f" expected at most {largest:g} {unit}",
            f"{remedy}, or split the episode there",
        )


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


def _check_column(path: Path, name: str, column: np.ndarray, limit: tuple[float, str, str]) -> None:
    finite = np.isfinite(column)
    if not finite.all():
        row = int(np.argmin(finite))
        raise EpisodeError(
            path,
            f"{row_name(row, path)}, column {name}: found {column[row]}, expected a finite number",
            "measure the step again, or split the episode there",
        )
    largest, unit, likely = limit
    if len(column) and np.abs(column).max() > largest:
        row = int(np.argmax(np.abs(column) > largest))
        raise EpisodeError(
            path,
            f"{row_name(row, path)}, column {name}: found {column[row]:g}, expected {unit}"
            f" (at most {largest:.3g}); it looks like {likely}",
            f"convert the column to {unit}",
        )


def check_episode(episode: Episode) -> list[str]:
    """Sentences on what is suspicious in an episode that obeys the format; often none.

    In equilibrium the wrench is K (pose - command); rows whose wrench has the opposite
    sign or another size speak for a sign or unit error of the sensor or of the stiffness.
    """
    warnings = []
    noise, largest_wrench = episode.sensor_std.numpy(), np.abs(episode.wrenches.numpy()).max(0)
    significant, felt = _beyond_noise(episode)
    for axis, (name, slope) in enumerate(wrench_slopes(episode).items()):
        if slope is None:
            if felt[:, axis].sum() >= LEAST_FELT:
                largest = largest_wrench[axis]
                warnings.append(
                    f"{name} reaches {largest:.3g} while K (pose - command) stays within the noise;"
                    " check the stiffness and the units"
                )
            continue
        if slope < INVERTED:
            warnings.append(inverted_sentence(name, slope))
        elif name == "tau" and _as_in_degrees(slope):
            warnings.append("; ".join(degrees_told(slope)))
        elif not 0.5 < slope < 2.0:
            warnings.append(
                f"{name} is {slope:.2g} times K (pose - command), expected about 1; check the"
                " stiffness, the units and whether the arm had settled"
            )
    if not significant.any() and not (felt.sum(0) >= LEAST_FELT).any():
        warnings.append(NO_CONTACT)
    warnings += map(str, repeated_readings(episode))
    silent = [name for name, value in zip(SENSOR_NAMES, noise, strict=True) if value == 0]
    if silent:
        warnings.append(f"sensor_std of {', '.join(silent)} is 0: {FREE_OF_NOISE}")
    return warnings


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
    for name, ratios in wrench_ratios(episode).items():
        if name == "tau":
            if all(map(_as_in_degrees, ratios)):
                raise EpisodeError(where, *degrees_told(ratios[0]))
        elif all(ratio < INVERTED for ratio in ratios):
            raise EpisodeError(where, inverted_sentence(name, ratios[0]), inverted_remedy(name))
        elif min(map(abs, ratios)) > ANOTHER_ORDER or ANOTHER_ORDER * max(map(abs, ratios)) < 1:
            told = f"{name} is {ratios[0]:.2g} times K (pose - command), expected about 1"
            raise EpisodeError(where, told, "check the stiffness and the units")


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


def _as_in_degrees(ratio: float) -> bool:
    return 0.5 < math.degrees(ratio) < 2.0


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


def inverted_remedy(name: str) -> str:
    """What to do with a channel that looks inverted."""
    return f"change the sign of the column {name}, or of its frame"


def inverted_sentence(name: str, slope: float) -> str:
    """What is said of a channel that looks inverted."""
    return (
        f"{name} looks inverted: it is {slope:.2f} times K (pose - command); expected is"
        " what the world exerts on the object, so pressing on the floor gives F_z > 0"
    )


def _expected_wrenches(episode: Episode) -> np.ndarray:
    deviations = (episode.poses - episode.commands).numpy()
    deviations[:, 2] = [math.remainder(angle, 2 * math.pi) for angle in deviations[:, 2]]
    return deviations * episode.stiffness.numpy()


def _beyond_noise(episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Entries (n, 3) of K (pose - command), and of the wrench, that are no noise."""
    noise = episode.sensor_std.numpy()
    limit = NOISE_FACTOR * np.hypot(noise[3:], episode.stiffness.numpy() * noise[:3]) + 1e-9
    return np.abs(_expected_wrenches(episode)) > limit, np.abs(episode.wrenches.numpy()) > limit
