"""A recording from elsewhere as an episode: plane, settled steps, noise, and doubts.

Row 0 of an episode is the free start pose with the command equal to it, so the first settled step
must be free of contact; its own command is replaced by the pose. A recording without commands comes
out as `measured` rows, which are kept but cannot be learnt from.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from tpcd.contract import SENSOR_NAMES, check_stiffness
from tpcd.data.checks import FREE_WRENCH, NOISE_FACTOR, episode_findings
from tpcd.data.episode import Episode
from tpcd.data.files import episode_contents
from tpcd.data.header import Header
from tpcd.data.measured import Measured, measured_contents
from tpcd.data.noise import check_noise
from tpcd.errors import EpisodeError
from tpcd.logs.conventions import RotationReading
from tpcd.logs.findings import (
    Account,
    account_of,
    dead_channels,
    doubt,
    left_out,
    spiked,
    spring_of,
    turned_out,
    zeroed_in_contact,
)
from tpcd.logs.joining import ROTATIONS
from tpcd.logs.log import AXES, Log, LogError
from tpcd.logs.plane import PlanarLog, Plane, WrenchReading, project
from tpcd.logs.readings import Readings, compare
from tpcd.logs.settled import BLOCKS, Settled, Stillness, find_settled, restless_commands
from tpcd.logs.units import doubted_units
from tpcd.quality.finding import Finding, Weight

NO_SET_POINTS = "no set points in the map: steps cannot be told apart, and nothing can be learnt"
ANGLES = [name for kind, names in ROTATIONS.items() if kind != "quaternion" for name in names]
PROVEN = {
    "force": [prefix + axis for prefix in ("", "u_", "F_") for axis in AXES],
    "torque": [prefix + name for prefix in ("", "u_") for name in ANGLES],
}
FREE_FORCE = 1.0
"""A start that is pressed harder than this by K (x - u) is not free [N]."""


@dataclass(frozen=True)
class Importing:
    """Choices of an import."""

    stiffness: tuple[float, float, float]
    """Of the impedance controller [N/m, N/m, N·m/rad] along x, z and about the angle's axis."""
    plane: Plane = field(default_factory=Plane)
    wrench: WrenchReading = field(default_factory=WrenchReading)
    rotation: RotationReading = field(default_factory=RotationReading)
    stillness: Stillness = field(default_factory=Stillness)
    tare: bool = False
    """Take what the sensor reads in the first settled step for its zero."""
    sensor_std: tuple[float, ...] | None = None
    """Noise of a row; None to take it from the still stretches."""
    object: str | None = None
    unusual: bool = False
    """That springs and lengths that look like other units are meant so."""

    def __post_init__(self) -> None:
        """Refuse stiffness and noise that cannot be."""
        check_stiffness(torch.tensor(self.stiffness, dtype=torch.float64), self.unusual)
        if self.sensor_std is not None and not all(0 <= s < math.inf for s in self.sensor_std):
            raise ValueError(f"sensor_std is {self.sensor_std}, expected six numbers from 0 up")


@dataclass(frozen=True, eq=False)
class Imported:
    """What an import found."""

    planar: PlanarLog
    settled: Settled
    spring: Float[np.ndarray, "k 3"]
    """K (x - u) of the settled rows; NaN without commands."""
    account: Account
    content: Episode | Measured
    header: Header

    def files(self, stem: Path) -> dict[Path, bytes]:
        """The files of the episode, NAME.csv and NAME.yaml; raises `EpisodeError`."""
        if isinstance(self.content, Measured):
            return measured_contents(self.content, self.header, stem)
        return {k: v for k, v in episode_contents(self.content, stem).items() if v is not None}


def import_log(log: Log, choices: Importing) -> Imported:
    """Bring a recording into the plane and cut it into settled rows; raises `LogError`.

    Where it stops, and units or conventions look otherwise than they were read, it says that.
    """
    log = choices.rotation.of(log)
    units = doubted_units(log)
    try:
        planar, settled, choices = _settle(log, choices)
    except LogError as error:
        likely = (*_better(_unsettled(log, choices), log), *units, *_late(log))
        raise _likelier(error, likely) from error
    read = _compared(log, settled, choices)
    stiffness = np.array(choices.stiffness)
    if read is not None and read.own.fits:
        # Forces that are K (x - u) are proof of their units and of those of positions, and so are
        # torques of angles.
        proven = {name for kind in read.own.left for name in PROVEN.get(kind, ())}
        units = tuple(e for e in units if not (e.channels and set(e.channels) <= proven))
    conventions = account_of(read, log)
    account = _told(log) + Account(_counted(log, planar, settled), units)
    account += left_out(planar)
    if read is None or not read.in_plane_otherwise:
        account += turned_out(log.path, planar)
    account += spiked(settled, choices.stillness)
    if not read or not read.exchanged:
        # What is not felt says nothing of conventions, and another point might fit it.
        conventions = dead_channels(settled, stiffness) or conventions
    account += conventions
    restless = _restless(settled, choices.stillness)
    std = choices.sensor_std
    if std is None and not restless:
        std = tuple(float(f"{value:.3g}") for value in settled.noise)
    if restless:
        told = ", ".join(f"{SENSOR_NAMES[k]} {settled.noise[k]:.2g}" for k in restless)
        still = f"the arm never stood still, so noise is unknown: means scatter by {told}"
        account += Account((), (doubt("still", still),))
    if choices.tare:
        zero = ", ".join(f"{v:.3g}" for v in choices.wrench.offset)
        account += Account((f"zero of the sensor: {zero}",))
    header = Header(
        stiffness=choices.stiffness,
        sensor_std=std,
        object=choices.object,
        notes=f"imported from {log.path.name}",
        time_step_s=None,
        priors={},
        commands_known=settled.commands is not None,
        unusual=choices.unusual,
    )
    extra, spring = _extra(log, settled), spring_of(settled, stiffness)
    if settled.commands is None:
        content = Measured(settled.rows[:, :3], settled.rows[:, 3:], extra)
        nothing = doubt("commands", NO_SET_POINTS)
        account = Account((*account.findings, content.summary()), (nothing, *account.doubts))
        header = replace(header, doubts=account.doubts)
        return Imported(planar, settled, spring, account, content, header)
    try:
        episode, finding = _episode(log, settled, header, extra)
    except LogError as error:
        raise _likelier(error, (*_better(read, log), *units, *_late(log))) from error
    except ValueError as error:
        told = LogError(log.path, str(error).partition("; ")[0], "check --map and --origin")
        raise _likelier(told, (*_better(read, log), *units, *_late(log))) from error
    account += zeroed_in_contact(settled, stiffness)
    account += Account((finding,)) + _of_episode(episode, bool(conventions.doubts))
    episode = replace(episode, doubts=account.doubts)
    header = replace(header, doubts=account.doubts)
    return Imported(planar, settled, spring, account, episode, header)


def _settle(log: Log, choices: Importing) -> tuple[PlanarLog, Settled, Importing]:
    """The recording in the plane, its settled rows, and the sensor's zero if it is asked for."""
    planar = project(log, choices.plane, choices.wrench)
    settled = find_settled(planar, choices.stillness)
    if choices.tare and len(settled.rows):
        choices = _tared(log, settled, choices)
        planar = project(log, choices.plane, choices.wrench)
        settled = find_settled(planar, choices.stillness)
    _check_rows(log, settled, choices, planar.commands)
    return planar, settled, choices


def _compared(log: Log, settled: Settled, choices: Importing) -> Readings | None:
    stiffness = np.array(choices.stiffness)
    return compare(log, choices.plane, choices.wrench, choices.rotation, settled, stiffness)


def _unsettled(log: Log, choices: Importing) -> Readings | None:
    """The test of the conventions of a recording that cannot be settled as it was read."""
    try:
        planar = project(log, replace(choices.plane, tool_x=None), choices.wrench)
    except LogError:
        return None
    return _compared(log, find_settled(planar, choices.stillness), choices)


def _better(read: Readings | None, log: Log) -> tuple[Finding, ...]:
    """What is said of readings that fit much better."""
    return account_of(read, log).serious if read is not None and read.better else ()


def _late(log: Log) -> tuple[Finding, ...]:
    """Delays between the streams, which spoil the ends of holds and so what settles there."""
    found = [e for e in log.findings if e.kind == "delay" and e.weight is Weight.DOUBT]
    return tuple(replace(each, weight=Weight.SERIOUS) for each in found)


def _likelier(error: LogError, doubts: tuple[Finding, ...]) -> LogError:
    """The error, or the likely cause of it."""
    serious = [each for each in doubts if each.weight is Weight.SERIOUS]
    if not serious:
        return error
    remedies = dict.fromkeys(each.remedy for each in serious if each.kind == serious[0].kind)
    told = f"{serious[0].sentence} (so {error.problem})"
    return LogError(error.path, told, "; ".join(remedies))


def _of_episode(episode: Episode, doubted: bool) -> Account:
    """What the rows themselves speak against; what conventions explain is said already."""
    explained = ("inverted", "unit", "wrench", "contact") if doubted else ()
    found = [each for each in episode_findings(episode) if each.kind not in explained]
    notes = tuple(str(each) for each in found if each.weight is Weight.NOTE)
    found = [each for each in found if each.weight is not Weight.NOTE]
    try:
        found += [doubt("noise", line) for line in check_noise(episode)]
    except EpisodeError as error:
        found.append(doubt("noise", error.problem, error.remedy, serious=True))
    return Account(notes, tuple(found))


def _tared(log: Log, settled: Settled, choices: Importing) -> Importing:
    first, end = settled.stretches[0]
    zero = np.concatenate((log.forces[first:end].mean(0), log.torques[first:end].mean(0)))
    wrench = replace(choices.wrench, offset=tuple(zero.tolist()))
    return replace(choices, wrench=wrench)


def _check_rows(
    log: Log,
    settled: Settled,
    choices: Importing,
    commands: Float[np.ndarray, "n 3"] | None,
) -> None:
    if len(settled.rows) > 1 or (settled.commands is None and len(settled.rows)):
        return
    window = choices.stillness.window
    each = float(np.median(np.diff(log.times)))
    rare = 2 * BLOCKS * each > window
    if not settled.broken and (settled.commands is None or (settled.brief and rare)):
        raise LogError(
            log.path,
            f"no {window:g} s hold the {2 * BLOCKS} samples of a row: they come every {each:.3g} s",
            "raise --window, or record faster",
        )
    found = f"{len(settled.rows)} settled steps in {log.times[-1]:.3g} s"
    if settled.broken:
        problem = f"{len(settled.broken)} of them lie in what is left out"
        remedy = "; ".join(str(f) for f in log.findings if f.weight is Weight.LEFT_OUT)
    elif settled.unsettled:
        problem = f"{len(settled.unsettled)} holds end while the arm still moves"
        remedy = "allow more --drift, or record longer holds"
    elif restless := restless_commands(log.times, commands, window):
        problem, remedy = restless, "map the set point as it was sent, before filters and noise"
    elif settled.brief:
        problem, remedy = f"{settled.brief} holds are shorter than {window:g} s", "lower --window"
    else:
        problem = f"no command is held for {window:g} s"
        remedy = "lower --window, or map the commanded pose and not a trajectory"
    raise LogError(log.path, f"{found}, expected a free start and one more: {problem}", remedy)


def _told(log: Log) -> Account:
    """What was found in the recording itself."""
    doubts = (Weight.DOUBT, Weight.SERIOUS)
    found = [each for each in log.findings if each.kind != "unit"]
    return Account(log.notes) + Account(
        tuple(f"{each.weight.value}: {each}" for each in found if each.weight not in doubts),
        tuple(each for each in found if each.weight in doubts),
    )


def _counted(log: Log, planar: PlanarLog, settled: Settled) -> tuple[str, ...]:
    steps = np.diff(log.times)
    rate = f"{len(log)} samples in {log.times[-1]:.3g} s (every {1e3 * np.median(steps):.2g} ms"
    rate += f", at most {1e3 * steps.max():.3g} ms)"
    if planar.commands is None:
        told = [f"{rate}, in {len(settled.rows)} stretches"]
    else:
        told = [f"{rate}, {len(settled.rows)} settled steps"]
    if settled.broken:
        told.append(
            f"{len(settled.broken)} stretches make no row, for part of them is left out:"
            f" they end at {_times(settled.broken)} s; the steps after them went by way of them"
        )
    if settled.unsettled:
        told.append(
            f"{len(settled.unsettled)} holds left out, for the arm still moved at their ends"
            f" ({_times(settled.unsettled)} s); the steps after them went by way of them"
        )
    if settled.brief:
        told.append(f"{settled.brief} holds too short for a row")
    return tuple(told)


def _times(times: tuple[float, ...]) -> str:
    return ", ".join(f"{time:.1f}" for time in times[:8]) + (", …" if len(times) > 8 else "")


def _restless(settled: Settled, stillness: Stillness) -> list[int]:
    """Channels that scatter so much, where no still rows were chosen, that it must be motion."""
    if settled.commands is not None:
        return []
    return [int(k) for k in np.flatnonzero(4 * settled.noise > stillness.channels)]


def _extra(log: Log, settled: Settled) -> dict[str, np.ndarray]:
    """Times at which the rows were read, and the further columns then."""
    extra = {"time_s": np.array([log.times[end - 1] for _, end in settled.stretches])}
    for name, column in log.extra.items():
        if column.dtype.kind == "f":
            extra[name] = np.array([column[a:b].mean() for a, b in settled.stretches])
        else:
            extra[name] = np.array([column[b - 1] for _, b in settled.stretches])
    return extra


def _episode(
    log: Log, settled: Settled, header: Header, extra: dict[str, np.ndarray]
) -> tuple[Episode, str]:
    """The episode, and what was done to its first row."""
    assert settled.commands is not None and header.sensor_std is not None
    commands, rows = settled.commands.copy(), settled.rows.copy()
    stiffness = np.array(header.stiffness)
    pressed = spring_of(settled, stiffness)[0]
    begun = float(extra["time_s"][0])
    lost = sum(time < begun for time in (*settled.broken, *settled.unsettled))
    before = (
        f"; {lost} holds before it make no row, for the arm still moved or samples are left out"
    )
    before = before if lost else ""
    if np.linalg.norm(pressed[:2]) > FREE_FORCE:
        raise LogError(
            log.path,
            f"the first settled step (at {begun:.3g} s) is pressed by K (x - u) ="
            f" ({pressed[0]:.2g}, {pressed[1]:.2g}) N, expected a free start{before}",
            "begin with --start at a step without contact, and check --stiffness",
        )
    allowed = NOISE_FACTOR * np.array(header.sensor_std[3:]) + FREE_WRENCH
    if (np.abs(rows[0, 3:]) > allowed).any():
        read = ", ".join(f"{value:.2g}" for value in rows[0, 3:])
        raise LogError(
            log.path,
            f"the sensor reads ({read}) N, N, N·m at the free start, expected 0 within"
            f" {', '.join(f'{value:.2g}' for value in allowed)}{before}",
            "subtract it with --tare, or begin elsewhere with --start",
        )
    away = rows[0, :3] - commands[0]
    commands[0] = rows[0, :3]
    for values in (commands, rows):
        values[:, 2] = np.pi - np.remainder(np.pi - values[:, 2], 2 * np.pi)
    finding = (
        f"the start is {1e3 * away[0]:.2g} mm, {1e3 * away[1]:.2g} mm,"
        f" {math.degrees(away[2]):.2g} degrees from its command, which is set to the pose"
    )
    episode = Episode(
        commands=torch.from_numpy(commands),
        poses=torch.from_numpy(rows[:, :3].copy()),
        wrenches=torch.from_numpy(rows[:, 3:].copy()),
        stiffness=torch.tensor(header.stiffness, dtype=torch.float64),
        sensor_std=torch.tensor(header.sensor_std, dtype=torch.float64),
        object=header.object,
        notes=header.notes,
        extra=extra,
        unusual=header.unusual,
    )
    return episode, finding
