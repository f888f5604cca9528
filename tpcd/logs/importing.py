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

from tpcd.data.checks import FREE_WRENCH, NOISE_FACTOR, check_episode
from tpcd.data.episode import Episode
from tpcd.data.files import episode_contents
from tpcd.data.header import SENSOR_NAMES, Header
from tpcd.data.measured import Measured, measured_contents
from tpcd.data.noise import check_noise
from tpcd.errors import EpisodeError
from tpcd.logs.findings import Account, compare_readings, left_out, spring_wrench
from tpcd.logs.log import Log, LogError
from tpcd.logs.plane import PlanarLog, Plane, WrenchReading, project
from tpcd.logs.settled import BLOCKS, Settled, Stillness, find_settled
from tpcd.quality.finding import Weight

FREE_FORCE = 1.0
"""A start that is pressed harder than this by K (x - u) is not free [N]."""


@dataclass(frozen=True)
class Importing:
    """Choices of an import."""

    stiffness: tuple[float, float, float]
    """Of the impedance controller [N/m, N/m, N·m/rad] along x, z and about the angle's axis."""
    plane: Plane = field(default_factory=Plane)
    wrench: WrenchReading = field(default_factory=WrenchReading)
    stillness: Stillness = field(default_factory=Stillness)
    tare: bool = False
    """Take what the sensor reads in the first settled step for its zero."""
    sensor_std: tuple[float, ...] | None = None
    """Noise of a row; None to take it from the still stretches."""
    object: str | None = None

    def __post_init__(self) -> None:
        """Refuse stiffness and noise that cannot be."""
        if not all(math.isfinite(k) and k > 0 for k in self.stiffness):
            raise ValueError(f"stiffness is {self.stiffness}, expected three positive numbers")
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
    """Bring a recording into the plane and cut it into settled rows; raises `LogError`."""
    planar = project(log, choices.plane, choices.wrench)
    settled = find_settled(planar, choices.stillness)
    if choices.tare and len(settled.rows):
        log, choices = _tared(log, settled, choices)
        planar = project(log, choices.plane, choices.wrench)
        settled = find_settled(planar, choices.stillness)
    _check_rows(log, settled, choices)
    stiffness = np.array(choices.stiffness)
    outside = left_out(planar)
    read = compare_readings(log, choices.plane, choices.wrench, settled, stiffness)
    told = _told(log)
    findings = [
        *log.notes,
        *told.findings,
        *_counted(log, planar, settled),
        *outside.findings,
        *read.findings,
    ]
    doubts = [*told.doubts, *outside.doubts, *read.doubts]
    restless = _restless(settled, choices.stillness)
    std = choices.sensor_std
    if std is None and not restless:
        std = tuple(float(f"{value:.3g}") for value in settled.noise)
    if restless:
        told = ", ".join(f"{SENSOR_NAMES[k]} {settled.noise[k]:.2g}" for k in restless)
        doubts.append(f"the arm never stood still, so noise is unknown: means scatter by {told}")
    if choices.tare:
        findings.append(
            "zero of the sensor: " + ", ".join(f"{v:.3g}" for v in choices.wrench.offset)
        )
    header = Header(
        stiffness=choices.stiffness,
        sensor_std=std,
        object=choices.object,
        notes=f"imported from {log.path.name}",
        time_step_s=None,
        priors={},
        commands_known=settled.commands is not None,
    )
    extra = _extra(log, settled)
    if settled.commands is None:
        content = Measured(settled.rows[:, :3], settled.rows[:, 3:], extra)
        doubts.insert(
            0, "no set points in the map: steps cannot be told apart, and nothing can be learnt"
        )
        findings.append(content.summary())
        spring = spring_wrench(settled, stiffness)
        account = Account(tuple(findings), tuple(doubts))
        return Imported(planar, settled, spring, account, content, header)
    episode, finding = _episode(log, settled, header, extra)
    doubted = check_episode(episode)
    doubts += [line for line in doubted if not (read.doubts and "times K (pose" in line)]
    try:
        doubts += check_noise(episode)
    except EpisodeError as error:
        doubts.append(error.problem)
    account = Account((*findings, finding), tuple(doubts))
    return Imported(planar, settled, spring_wrench(settled, stiffness), account, episode, header)


def _tared(log: Log, settled: Settled, choices: Importing) -> tuple[Log, Importing]:
    first, end = settled.stretches[0]
    zero = np.concatenate((log.forces[first:end].mean(0), log.torques[first:end].mean(0)))
    wrench = replace(choices.wrench, offset=tuple(zero.tolist()))
    return log, replace(choices, wrench=wrench)


def _check_rows(log: Log, settled: Settled, choices: Importing) -> None:
    if len(settled.rows) > 1 or (settled.commands is None and len(settled.rows)):
        return
    window = choices.stillness.window
    if settled.commands is None and not settled.broken:
        each = float(np.median(np.diff(log.times)))
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
    elif settled.brief:
        problem, remedy = f"{settled.brief} holds are shorter than {window:g} s", "lower --window"
    else:
        problem = f"no command is held for {window:g} s"
        remedy = "lower --window, or map the commanded pose and not a trajectory"
    raise LogError(log.path, f"{found}, expected a free start and one more: {problem}", remedy)


def _told(log: Log) -> Account:
    """What was found in the recording itself."""
    doubts = (Weight.DOUBT, Weight.SERIOUS)
    return Account(
        tuple(f"{each.weight.value}: {each}" for each in log.findings if each.weight not in doubts),
        tuple(str(each) for each in log.findings if each.weight in doubts),
    )


def _counted(log: Log, planar: PlanarLog, settled: Settled) -> list[str]:
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
    return told


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
    pressed = spring_wrench(settled, stiffness)[0]
    if np.linalg.norm(pressed[:2]) > FREE_FORCE:
        raise LogError(
            log.path,
            f"the first settled step (at {extra['time_s'][0]:.3g} s) is pressed by K (x - u) ="
            f" ({pressed[0]:.2g}, {pressed[1]:.2g}) N, expected a free start",
            "begin with --start at a step without contact, and check --stiffness",
        )
    allowed = NOISE_FACTOR * np.array(header.sensor_std[3:]) + FREE_WRENCH
    if (np.abs(rows[0, 3:]) > allowed).any():
        read = ", ".join(f"{value:.2g}" for value in rows[0, 3:])
        raise LogError(
            log.path,
            f"the sensor reads ({read}) N, N, N·m at the free start, expected 0 within"
            f" {', '.join(f'{value:.2g}' for value in allowed)}",
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
    )
    return episode, finding
