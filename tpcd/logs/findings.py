"""What an import found, in sentences for the person who decides whether to take it.

`findings` say what was done; `doubts` are what speaks against using it as it is, such as a wrench
that looks inverted, given in other axes, or a motion that is not planar. They go with the episode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tpcd.contract import SENSOR_NAMES
from tpcd.logs.hypotheses import BEYOND_NOISE, LEAST_TURN, MISSED, WITHIN, Reading
from tpcd.logs.log import Log, LogError
from tpcd.logs.plane import PlanarLog
from tpcd.logs.readings import Readings, same_episode
from tpcd.logs.remains import SURE
from tpcd.logs.settled import Settled, Stillness
from tpcd.planar import spring_wrench
from tpcd.quality.finding import Finding, Weight, usable

OUT_OF_PLANE_MOTION = 0.1
"""Motion out of the plane beyond this part of that within it is doubtful."""
OUT_OF_PLANE_FORCE = 0.2
"""The same of forces."""
OUT_OF_PLANE_TURN, LOST = 0.5, 2.5
"""Rotation out of the plane beyond this [rad] is doubtful; near half a turn there is no angle in
the plane."""
MISLEADS = 0.2
"""A reading that leaves so much more than another makes an episode that misleads."""
SWING_TOLD = 0.1
"""Part of the rotation out of the plane that is worth a word here."""
LEAST_PRESSED, PRESSED_ALIKE = 0.2, 0.5
"""A start pressed by less is free [N]; and a part of it within which readings are its negative."""
LEAST_ZEROED = 2
"""Rows that show a zero taken in contact."""
NOTHING_FELT = "K (x - u) is nowhere more than 1 N: no contact is felt"
LARGE = 0.1
"""Part of the load of a channel below which it is arms and sensors as they are."""
SENSOR_UNITS = ("m", "m", "rad", "N", "N", "N·m")
SHOWN = (1.0, 1.0, 0.05)
"""Changes of K (x - u) that friction of an arm does not hide [N, N, N·m]."""
CHANNELS, UNITS = ("F_x", "F_z", "tau"), ("N", "N", "N·m")


@dataclass(frozen=True)
class Account:
    """Sentences on one import."""

    findings: tuple[str, ...] = ()
    doubts: tuple[Finding, ...] = ()

    @property
    def serious(self) -> tuple[Finding, ...]:
        """The doubts that need a word of their own to be accepted."""
        return tuple(doubt for doubt in self.doubts if doubt.weight is Weight.SERIOUS)

    def __add__(self, other: Account) -> Account:
        """Both."""
        return Account(self.findings + other.findings, self.doubts + other.doubts)


def doubt(kind: str, sentence: str, remedy: str = "", serious: bool = False) -> Finding:
    """What speaks against an import."""
    return Finding(kind, Weight.SERIOUS if serious else Weight.DOUBT, sentence, remedy=remedy)


def left_out(planar: PlanarLog) -> Account:
    """How much motion and force the plane leaves out, of the samples that can be used."""
    planar = _used(planar)
    inside, outside = (
        np.ptp(planar.poses[:, :2], axis=0).max(),
        np.ptp(planar.motion_left_out[:, 0]),
    )
    swing = planar.motion_left_out[:, 1].max()
    force = np.abs(planar.wrench_left_out[:, 0]).max()
    torque = np.abs(planar.wrench_left_out[:, 1:]).max()
    held = np.linalg.norm(planar.wrenches[:, :2], axis=1).max()
    finding = (
        f"the plane leaves out {_told(1e3 * outside)} mm of motion (within it {1e3 * inside:.3g}"
        f" mm), {_told(math.degrees(swing))} degrees of rotation, {_told(force)} N of force (within"
        f" it {held:.3g} N) and {_told(torque)} N·m of torque"
    )
    doubts = []
    if outside > OUT_OF_PLANE_MOTION * inside:
        doubts.append(
            doubt("plane", "much of the motion is out of the plane: check --plane_x and --plane_z")
        )
    if force > OUT_OF_PLANE_FORCE * held:
        told = "much of the force is out of the plane: check the plane and --wrench_frame"
        doubts.append(doubt("plane", told))
    return Account((finding,), tuple(doubts))


def turned_out(path: Path, planar: PlanarLog) -> Account:
    """Whether much of the rotation is out of the plane; raises `LogError` where it has no angle in
    the plane any more."""
    planar, doubts = _used(planar), ()
    parts = [("end effector", planar.motion_left_out[:, 1])]
    if planar.command_swing is not None:
        parts.append(("set point", planar.command_swing))
    for what, swing in parts:
        k = int(np.argmax(swing))
        if swing[k] > LOST:
            raise LogError(
                path,
                f"the {what} is turned out of the plane by {math.degrees(swing[k]):.0f} degrees at"
                f" {planar.times[k]:.4g} s, where it has no angle in the plane",
                "choose the plane about whose normal it turns (--plane_x, --plane_z), or the part"
                " that does with --start and --end",
            )
        if swing[k] > OUT_OF_PLANE_TURN:
            told = f"much of the rotation of the {what} is out of the plane"
            doubts = (doubt("plane", told, "check --plane_x and --plane_z"),)
    return Account((), doubts)


def account_of(read: Readings | None, log: Log) -> Account:
    """What the test of the conventions says: what is left of K (x - u), and what fits better."""
    if read is None:
        return Account()
    own, rows = read.own, len(read.own.rows)
    planar_angle = log.numbers is not None and log.numbers.kind == "planar angle"
    if not {"force", "torque"} & set(own.left) and not read.better:
        return Account((), (doubt("contact", NOTHING_FELT),)) + _untold(read, planar_angle)
    finding = f"over {rows} settled rows K (x - u) leaves {_left(own)} unexplained"
    account = Account((finding,)) + _untold(read, planar_angle)
    if read.better:
        return account + Account((), (_looks_otherwise(read),))
    if not own.fits:
        lone = log.numbers is not None and log.command_numbers is None
        if lone and own.left.get("force", 0.0) <= MISSED:
            told = (
                "the rotation of the set point is not in the map, and with that of the start"
                f" {own.left['torque']:.0%} of the torque is unexplained over {rows} rows"
            )
            remedy = "map it: u_qx u_qy u_qz u_qw, u_rx u_ry u_rz, u_e1 u_e2 u_e3 or u_phi"
            return account + Account((), (doubt("convention", told, remedy, serious=True),))
        causes = [each for each in _causes(read) if "bends" in each]
        told = (
            "no order, sense, sign, frame or unit of rotations and wrench fits K (x - u):"
            f" it leaves {_left(own)} over {rows} rows" + "".join(f"; {each}" for each in causes)
        )
        remedy = "check stiffness, plane and units, and which columns are mapped"
        return account + Account((), (doubt("convention", told, remedy, serious=True),))
    if causes := _causes(read):
        told = f"the wrench is not K (x - u) over {rows} rows: {'; '.join(causes)}"
        remedy = "look at the panels against K (x - u), and run scripts/check.py --stiffness"
        account += Account((), (doubt("parity", told, remedy),))
    account += _friction(read)
    if own.depth < WITHIN:
        told = (
            "forces would act from within the object: by their torques the hand lies beyond the"
            f" contact they come from, by {-own.depth:.2g} standard errors, as where angle and"
            " torque are both measured from z to x"
        )
        remedy = "look whether phi grows as the hand turns from x to z; else --invert_rotation"
        return account + Account((), (doubt("mirrored", told, f"{remedy} --invert_torque"),))
    return account


def spiked(settled: Settled, stillness: Stillness) -> Account:
    """Rows whose mean is not what most of their samples read."""
    if settled.off_median is None:
        return Account()
    far = settled.off_median > stillness.channels / 2.0
    told = [
        f"{SENSOR_NAMES[k]} in {int(far[:, k].sum())} of {len(far)} rows, by up to"
        f" {settled.off_median[:, k].max():.2g} {SENSOR_UNITS[k]}"
        for k in np.flatnonzero(far.any(0))
    ]
    if not told:
        return Account()
    sentence = (
        "the mean of the samples is not what most of them read, as where single ones are spikes or"
        f" filled in: {', '.join(told)}"
    )
    return Account((), (doubt("spikes", sentence, "look at the sensor's cable and driver"),))


def dead_channels(settled: Settled, stiffness: Float[np.ndarray, " 3"]) -> Account | None:
    """Forces and torque that read one number in all rows, though the springs pull differently."""
    if settled.commands is None or len(settled.rows) < 2:
        return None
    spring = np.ptp(spring_of(settled, stiffness), axis=0)
    dead = np.flatnonzero((np.ptp(settled.rows[:, 3:], axis=0) == 0) & (spring > SHOWN))
    if not len(dead):
        return None
    told = "; ".join(
        f"{CHANNELS[k]} reads {settled.rows[0, 3 + k]:.4g} in all {len(settled.rows)} rows, where"
        f" K (x - u) changes by {spring[k]:.2g} {UNITS[k]}"
        for k in dead
    )
    remedy = "map the columns that hold it, or measure again"
    return Account((), (doubt("dead", f"{told}: not recorded", remedy, serious=True),))


def zeroed_in_contact(settled: Settled, stiffness: Float[np.ndarray, " 3"]) -> Account:
    """Whether the sensor reads minus what the arm pressed with at the start where nothing presses.

    Such a sensor had its zero taken in contact; an arm that lags, or a dead band, leaves its
    readings at zero.
    """
    spring = spring_of(settled, stiffness)[:, :2]
    noise = np.hypot(settled.noise[3:5], stiffness[:2] * settled.noise[:2])
    least = max(BEYOND_NOISE * float(np.linalg.norm(noise)), LEAST_PRESSED)
    begun = spring[0]
    if not np.linalg.norm(begun) > least:
        return Account()
    allowed = max(least, PRESSED_ALIKE * float(np.linalg.norm(begun))) / 2
    free = np.linalg.norm(spring, axis=1) < allowed
    minus = np.linalg.norm(settled.rows[:, 3:5] + begun, axis=1) < allowed
    rows = int((free & minus).sum())
    if rows < LEAST_ZEROED or rows < free.sum() / 2:
        return Account()
    told = (
        f"the sensor was zeroed in contact: the arm presses with K (x - u) = ({begun[0]:.2g},"
        f" {begun[1]:.2g}) N at the start, where the sensor reads 0, and the sensor reads minus"
        f" that in {rows} rows in which nothing presses"
    )
    remedy = "begin with --start at a step that is free, and take its zero there with --tare"
    return Account((), (doubt("zero", told, remedy, serious=True),))


def _looks_otherwise(read: Readings) -> Finding:
    """The readings that fit much better, and what tells those apart that fit alike."""
    best, own = read.better[0], read.own
    said = f"{best.said}: then K (x - u) would leave {_left(best)} unexplained, instead of"
    said += f" {_left(own)}, over {len(own.rows)} rows ({_times_likelier(best, own)})"
    remedy = best.remedy
    for other in read.better[1:3]:
        if same_episode(best, other):
            said += f"; the same episode comes of reading that {other.said}"
        else:
            said += f"; or {other.said}, which fits alike but makes another episode"
            if other.depth < WITHIN:
                said += ", in which forces act from within the object"
            remedy += f", or {other.remedy}; {_apart(best, other)}"
    lost = max(own.left.get(name, 0.0) for name in ("force", "torque", "rotation"))
    told = f"the recording was read otherwise than it looks: {said}"
    return doubt("convention", told, remedy, serious=lost > MISLEADS)


def _causes(read: Readings) -> list[str]:
    """What w - K (x - u) is made of that speaks against the sensor or the stiffness."""
    found, causes = read.remains, []
    load = np.sqrt((read.own.rows[:, 6:] ** 2).mean(0))
    if off := _certain(found.factor - [[1.0], [0.0]], np.ones(3)):
        shown = ", ".join(
            f"{CHANNELS[k]} is {found.factor[0, k]:.3g} (± {found.factor[1, k]:.1g})" for k in off
        )
        causes.append(f"{shown} times it: another stiffness, or a gain of the sensor")
    if drifts := _certain(found.drift, load):
        shown = _amounts(found.drift, drifts)
        causes.append(f"it drifts by {shown} from the first row to the last")
    if off := _certain(found.offset, load):
        shown = _amounts(found.offset, off)
        causes.append(f"it is off by {shown} in all rows, as where set points are of another point")
    if bent := _certain(found.bend, load):
        shown = _amounts(found.bend, bent)
        causes.append(f"it bends by {shown} where it is largest, as of a sensor that saturates")
    return causes


def _friction(read: Readings) -> Account:
    """What friction holds, as arms have it."""
    found = read.remains.friction
    held = [k for k in range(3) if found[0, k] > SURE * found[1, k]]
    if not held:
        return Account()
    told = f"friction of the arm holds {_amounts(found, held)} against its last motion"
    return Account((f"{told}, beside K (x - u)",))


def _certain(values: Float[np.ndarray, "2 3"], load: Float[np.ndarray, " 3"]) -> list[int]:
    """Channels in which a cause is there, and larger than is usual of arms and sensors."""
    off, error = np.abs(values[0]), values[1]
    return [
        k for k in range(3) if off[k] > SURE * error[k] and off[k] - 2 * error[k] > LARGE * load[k]
    ]


def _amounts(values: Float[np.ndarray, "2 3"], chosen: list[int]) -> str:
    return ", ".join(
        f"{CHANNELS[k]} {values[0, k]:.2g} (± {values[1, k]:.1g}) {UNITS[k]}" for k in chosen
    )


def _untold(read: Readings, planar_angle: bool) -> Account:
    """What the recording cannot tell about its conventions."""
    told = [
        f"nothing in the recording shows whether {other.said}: {_apart(read.own, other)}"
        for other in read.alike
    ]
    if 0 < read.turned < LEAST_TURN:
        told.append(
            f"the arm turns by {math.degrees(read.turned):.2g} degrees only, so neither the order"
            " nor the sense of its rotations shows: turn it by 10 degrees or more while it presses"
        )
    elif planar_angle and abs(read.own.depth) < -WITHIN:
        told.append(
            "that phi and tau turn from x to z rests on the map alone: nothing in the recording"
            " shows it; press and slide in both directions to see"
        )
    return Account(tuple(told))


def _apart(first: Reading, second: Reading) -> str:
    """The motion that tells two readings apart."""
    subjects = {change.subject for change in set(first.changes) ^ set(second.changes)}
    if {"torque", "sense", "order"} & subjects:
        return (
            "to tell, turn the hand from x towards z, where phi must grow, and press on what lies"
            " on its +x side, where tau must be positive"
        )
    if {"length", "force", "unit of angles"} & subjects:
        return "to tell, move the hand by a known distance and hang a known weight on it"
    return "to tell, turn the hand by 30 degrees or more and press again"


def _left(reading: Reading) -> str:
    """Parts of force and torque, and of rotation if it matters, in words."""
    told = [f"{part:.0%} of {name}" for name, part in reading.left.items() if name != "rotation"]
    swing = reading.left.get("rotation", 0.0)
    if swing > SWING_TOLD:
        told.append(f"{swing:.0%} of the rotation, out of the plane")
    return " and ".join(told) or "nothing"


def _times_likelier(best: Reading, own: Reading) -> str:
    return f"10^{(best.likelihood - own.likelihood) / math.log(10):.0f} times as likely"


def _used(planar: PlanarLog) -> PlanarLog:
    kept = usable(planar.times, planar.findings)
    if not kept.any():
        return planar
    return replace(
        planar,
        times=planar.times[kept],
        poses=planar.poses[kept],
        commands=None,
        wrenches=planar.wrenches[kept],
        motion_left_out=planar.motion_left_out[kept],
        wrench_left_out=planar.wrench_left_out[kept],
        command_swing=None if planar.command_swing is None else planar.command_swing[kept],
    )


def spring_of(settled: Settled, stiffness: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "k 3"]:
    """K (x - u) of the settled rows [N, N, N·m]; NaN where commands are unknown."""
    if settled.commands is None:
        return np.full((len(settled.rows), 3), np.nan)
    return spring_wrench(settled.rows[:, :3], settled.commands, stiffness)


def _told(value: float) -> str:
    """A number for people; what is below any sensor is 0."""
    return f"{value:.2g}" if abs(value) > 1e-6 else "0"
