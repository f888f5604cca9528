"""Streams of a recording brought to the times of its pose.

A wrench is interpolated between two neighbouring samples that both hold numbers and are no gap
apart; a set point holds until the next one comes. Samples are taken in the order in which they were
recorded: what comes late or repeats a time is left out, nothing is sorted.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from tpcd.logs.log import Log, LogError, RotationKind, RotationNumbers
from tpcd.quality.defaults import find_defaults
from tpcd.quality.delay import estimate_delays
from tpcd.quality.finding import Finding, Weight, overlapping
from tpcd.quality.recording import check_recording
from tpcd.quality.stream import MOST_GAP, Stream, forward, gaps_of, read, role, says_again

ROTATIONS: dict[RotationKind, tuple[str, ...]] = {
    "rotation vector": ("rx", "ry", "rz"),
    "quaternion": ("qx", "qy", "qz", "qw"),
    "Euler angles": ("e1", "e2", "e3"),
    "planar angle": ("phi",),
}
NO_TURN = 1e-3
"""A quaternion shorter than this is none: some senders fill with zeros."""
COARSE = 0.85
"""Of times that so many samples share with the one before nothing can be told."""
DELAYS = ("pose", "wrench", "command")


def parse_delays(entries: Sequence[str]) -> dict[str, float]:
    """Delays [s] by stream from NAME=SECONDS, or {"auto": 0} ; raises `ValueError`."""
    found: dict[str, float] = {}
    for entry in entries:
        name, _, text = entry.partition("=")
        try:
            found[name] = 0.0 if entry == "auto" else float(text)
        except ValueError:
            found = {}
        if name not in (*DELAYS, "auto") or not np.isfinite(list(found.values()) or [np.nan]).all():
            expected = "auto, pose=SECONDS, wrench=SECONDS or command=SECONDS"
            raise ValueError(f"delay: found {entry!r}, expected {expected}")
    return found


def join(
    path: Path,
    streams: Sequence[Stream],
    euler: str = "ZYX",
    delays: Mapping[str, float] | None = None,
    findings: Sequence[Finding] = (),
    notes: Sequence[str] = (),
    missing: frozenset[str] = frozenset(),
    extra: Mapping[str, np.ndarray] | None = None,
) -> Log:
    """The recording at the times of its pose, where all streams have begun and none is in a gap.

    Each stream is given earlier by its delay [s], or by what motion and force tell ("auto").
    `findings` are in the times of the streams; `extra` columns go with the samples of the pose.
    Raises `LogError` where the streams do not overlap, or rotations cannot be read.
    """
    turns = [_only_readings(stream) for stream in streams]
    notes = [*notes, *(note for _, told in turns for note in told)]
    parts = {role(stream): stream for stream, _ in turns}
    parts, told = _moved(parts, dict(delays or {}))
    pose, wrench, command = parts["pose"], parts["wrench"], parts.get("command")
    _check_overlap(path, list(parts.values()), [note for _, told in turns for note in told])
    fresh = forward(pose.times)
    again = int((np.diff(pose.times) == 0).sum())
    fresher = (np.diff(pose.times) == 0) & (np.diff(pose.values, axis=0) != 0).any(1)
    if fresher.sum() > COARSE * len(pose.times):
        raise LogError(
            path,
            f"{int(fresher.sum())} of {len(pose.times)} samples are new at the time of the one"
            " before: the times have too few digits",
            "write them with more, or leave them out and give --rate in Hz",
        )
    if again:
        notes.append(f"{again} samples repeat the time before and are left out")
    if int((~fresh).sum()) > again:
        notes.append(f"{int((~fresh).sum()) - again} samples come late and are left out")
    at, own = _forward(pose)
    values = dict(zip(pose.channels, own.T, strict=True))
    values.update(zip(wrench.channels, _interpolated(wrench, at, findings).T, strict=True))
    if command is not None:
        values.update(zip(command.channels, _held(command, at, findings).T, strict=True))
    good = functools.reduce(np.logical_and, (np.isfinite(column) for column in values.values()))
    if good.sum() < 2:
        held = ", ".join(
            f"{name} in {int(np.isfinite([values[n] for n in part.channels]).all(0).sum())}"
            for name, part in parts.items()
        )
        raise LogError(
            path,
            f"{int(good.sum())} of {len(at)} samples of the pose have all numbers ({held})",
            "check the map or the topics, and what is missing",
        )
    if not good.all():
        values = {name: column[good] for name, column in values.items()}
    zero = float(at[good][0])
    moved = tuple(replace(part, times=part.times - zero) for part in parts.values())
    given = [_earlier(each, zero) for each in (*findings, *told)]
    found = []
    for each in check_recording(moved):
        # Where pieces were put together no samples can be, and that is told.
        seam = overlapping(each.start or 0.0, each.end or 0.0, given)
        found += [] if each.kind == "gap" and seam else [each]
    numbers, rotations = _rotations(values, "", euler, path)
    if rotations is None:
        notes.append("no rotation in the map: taken as constant")
        rotations, missing = Rotation.identity(int(good.sum())), missing | {"rotation"}
    turned = target = None
    if command is not None:
        target, turned = _rotations(values, "u_", euler, path)
        if turned is None:
            notes.append("no rotation of the set point in the map: taken as that of the start")
            turned = Rotation.from_quat(np.tile(rotations[:1].as_quat(), (len(rotations), 1)))
        elif numbers and target and target.kind != numbers.kind:
            notes.append(
                f"rotations are read from {numbers.kind}, those of the set point from {target.kind}"
            )
    if "tau" in values:
        # phi turns from x to z, about -y.
        values["T_y"] = -values["tau"]
    return Log(
        path,
        at[good] - zero,
        _stack(values, ("x", "y", "z")),
        rotations,
        _stack(values, ("F_x", "F_y", "F_z")),
        _stack(values, ("T_x", "T_y", "T_z")),
        None if command is None else _stack(values, ("u_x", "u_y", "u_z")),
        turned,
        missing,
        {name: column[fresh][good] for name, column in (extra or {}).items()},
        tuple(notes),
        moved,
        (*given, *found),
        numbers,
        target,
    )


def _only_readings(stream: Stream) -> tuple[Stream, list[str]]:
    """The stream without what is no reading: quaternions of length 0, which are no rotation, and
    what a driver fills in; and what is told."""
    values = np.where(np.isinf(stream.values), np.nan, stream.values)
    names, told = [name.removeprefix("u_") for name in stream.channels], []

    def without(none: Bool[np.ndarray, " k"], what: str) -> None:
        if none.any():
            told.append(
                f"{int(none.sum())} samples of {stream.name} {what}, and are left out"
                f" (the first is number {int(np.argmax(none)) + 1})"
            )
            values[none] = np.nan

    places = [names.index(name) for name in ROTATIONS["quaternion"] if name in names]
    if len(places) == 4:
        none = np.linalg.norm(values[:, places], axis=1) < NO_TURN
        without(none, "have a quaternion of length 0, which is no rotation")
    if role(stream) != "command":
        none = find_defaults(replace(stream, values=values))
        if none.any():
            shown = ", ".join(f"{value:.4g}" for value in values[np.argmax(none)])
            without(none, f"hold ({shown}) as a whole, which is filled in where nothing was read")
    return (replace(stream, values=values), told) if told else (stream, [])


def _moved(
    parts: dict[str, Stream], delays: dict[str, float]
) -> tuple[dict[str, Stream], list[Finding]]:
    """The streams without their delays, and what was done."""
    if delays.pop("auto", None) is not None:
        known = estimate_delays(list(parts.values()))
        delays = {each.of: each.value for each in known if each.doubtful} | delays
    told = []
    for name, delay in delays.items():
        if name in parts:
            part = parts[name]
            parts = {**parts, name: replace(part, times=part.times - delay)}
            sentence = f"{part.name}: the {name} is taken {delay:.3g} s earlier than it is recorded"
            told.append(Finding("moved", Weight.NOTE, sentence, part.channels))
    return parts, told


def _check_overlap(path: Path, parts: Sequence[Stream], notes: Sequence[str]) -> None:
    for part in parts:
        if not read(part).any():
            channels = ", ".join(
                name
                for k, name in enumerate(part.channels)
                if not np.isfinite(part.values[:, k]).any()
            )
            raise LogError(
                path,
                f"{part.name} has no sample with all of {', '.join(part.channels)}"
                + (f" ({channels} hold no number at all)" if channels and not notes else "")
                + "".join(f": {note}" for note in notes),
                "check the map of columns",
            )
    spans = {p.name: p.times[read(p)] for p in parts}
    begin = max(times[0] for times in spans.values())
    end = min(times[-1] for p in parts if role(p) != "command" for times in (spans[p.name],))
    if begin > end:
        told = "; ".join(f"{name} {t[0]:.2f} to {t[-1]:.2f} s" for name, t in spans.items())
        raise LogError(path, f"the streams do not overlap in time ({told})", "check the clocks")


def _interpolated(
    stream: Stream, times: Float[np.ndarray, " n"], findings: Sequence[Finding]
) -> Float[np.ndarray, "n w"]:
    """Values at some times; NaN where the samples around hold none, or are a gap apart."""
    own, values = _forward(stream)
    if np.array_equal(own, times):
        return values  # as in a table, whose rows have one time
    after = np.clip(np.searchsorted(own, times), 0, len(own) - 1)
    # A sample at the very time stands alone.
    before = np.where(own[after] == times, after, np.maximum(after - 1, 0))
    width = own[after] - own[before]
    share = np.divide(times - own[before], width, out=np.zeros(len(times)), where=width > 0)
    found = values[before] + share[:, None] * (values[after] - values[before])
    found[(times < own[0]) | (times > own[-1])] = np.nan
    cuts = [(each.start, each.end) for each in findings if overlapping(-np.inf, np.inf, [each])]
    for start, end in [*gaps_of(stream).tolist(), *cuts]:
        found[(times > start) & (times < end)] = np.nan
    return found


def _held(
    stream: Stream, times: Float[np.ndarray, " n"], findings: Sequence[Finding]
) -> Float[np.ndarray, "n w"]:
    """The last values at some times; NaN before the first."""
    own, values = _forward(stream)
    if np.array_equal(own, times):
        return values
    last = np.searchsorted(own, times, side="right") - 1
    found = np.where(last[:, None] < 0, np.nan, values[np.maximum(last, 0)])
    for start, end in gaps_of(stream).tolist():
        # Between pieces of a recording that were put together the set point is that before.
        if not overlapping(start, end, findings):
            found[(times > start) & (times < end)] = np.nan
    again = says_again(stream)
    return np.where((times > own[-1] + MOST_GAP)[:, None] & again, np.nan, found)


def _forward(stream: Stream) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k w"]]:
    """Times and values without what comes late."""
    fresh = forward(stream.times)
    if fresh.all():
        return stream.times, stream.values
    return stream.times[fresh], stream.values[fresh]


def _earlier(finding: Finding, by: float) -> Finding:
    start, end = finding.start, finding.end
    return replace(
        finding,
        start=None if start is None else start - by,
        end=None if end is None else end - by,
    )


def _stack(values: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    zero = np.zeros(len(next(iter(values.values()))))
    return np.stack([values.get(name, zero) for name in names], axis=1)


def _rotations(
    values: Mapping[str, np.ndarray], prefix: str, euler: str, path: Path
) -> tuple[RotationNumbers | None, Rotation | None]:
    """The numbers that the map gives for rotations, and what they mean; None without any."""
    begun = {
        kind: [prefix + name for name in names if prefix + name in values]
        for kind, names in ROTATIONS.items()
    }
    kinds: list[RotationKind] = [kind for kind in ROTATIONS if begun[kind]]
    if not kinds:
        return None, None
    kind = kinds[0]
    names = [prefix + name for name in ROTATIONS[kind]]
    if len(kinds) > 1 or begun[kind] != names:
        found = ", ".join(name for kind in kinds for name in begun[kind])
        raise LogError(path, f"{found} in the map", f"expected all of {', '.join(names)} alone")
    numbers = RotationNumbers(kind, np.stack([values[name] for name in names], axis=1), euler)
    try:
        return numbers, numbers.rotations()
    except ValueError as error:
        raise LogError(path, f"{kind} {', '.join(names)}: {error}", "check the map") from error
