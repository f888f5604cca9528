"""Messages of a bag in the order in which they were recorded, and the clock to time them by.

rosbags gives messages in the order of the recorder's clock. Where that was set back, this mixes
what came before with what came after, so the order in the file is asked for first. The stamps in
the headers are the better clock, made where something was measured, but they follow the sender's
wall clock. So they are taken where all messages have one and none jumps against the recorder's
clock; else the recorder's; and where that goes back too, the recording is cut into pieces there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from tpcd.quality.clocks import JUMP, clock_jumps
from tpcd.quality.finding import Finding, Weight

SEAM = 1.0
"""Put between two pieces, whose distance in time is not known [s]."""
APART = 1.0
"""Stamps of two topics that differ by more than this are of two clocks [s]: nothing that measures
takes as long to send."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """k messages of one topic, in the order in which they were recorded."""

    name: str
    frame: str
    places: Int[np.ndarray, " k"]
    """In the file, among all messages."""
    recorded: Int[np.ndarray, " k"]
    """The recorder's clock [ns]."""
    stamps: Int[np.ndarray, " k"]
    """In the header [ns]; 0 where there is none."""
    values: Float[np.ndarray, "k w"]


def places(reader: Any, connections: Sequence[Any], recorded: Int[np.ndarray, " k"]) -> np.ndarray:
    """Where in the file the messages of some connections stand, given in the reader's order.

    The reader sorts the messages of each of its files by time, and leaves alone what ties.
    """
    wanted = {(c.id, c.topic) for c in connections}
    files, times, at = [], [], []
    for k, (file, name, time) in enumerate(_scan(reader)):
        if name in wanted:
            files.append(file)
            times.append(time)
            at.append(k)
    order = np.lexsort((times, files))
    if len(times) != len(recorded) or (np.array(times, dtype=np.int64)[order] != recorded).any():
        return np.arange(len(recorded))
    return np.array(at, dtype=np.int64)[order]


def _scan(reader: Any) -> Iterator[tuple[int, tuple[int, str], int]]:
    """File, connection and the recorder's time of every message, in the order of the files."""
    for single in reader.readers:
        if hasattr(single, "indexes"):  # ROS 1
            names = {c.id: (c.id, c.topic) for c in single.connections}
            entries = [
                (entry.chunk_pos, entry.offset, entry.time, names[key])
                for key, index in single.indexes.items()
                for entry in index
            ]
            yield from ((0, name, time) for _, _, time, name in sorted(entries))
            continue
        storage = single.storage
        for k, file in enumerate(getattr(storage, "storages", [storage])):
            topics = {c.topic: (c.id, c.topic) for c in storage.connections}
            names = {c.id: topics[c.topic] for c in file.connections}
            if hasattr(file, "messages_scan"):  # MCAP
                for connection, time, _ in file.messages_scan(file.connections):
                    yield k, names[connection.id], time
            else:
                query = "SELECT topic_id, timestamp FROM messages ORDER BY id"
                yield from ((k, names[key], t) for key, t in file.dbconn.cursor().execute(query))


def common_clock(
    topics: Sequence[Recorded],
) -> tuple[list[Float[np.ndarray, " _"]], list[Float[np.ndarray, " _"] | None], list[Finding]]:
    """Times of the messages of all topics [s] on one clock, their stamps where those are another
    clock, and what was found, in the same times.

    Raises `ValueError` where neither clock tells the time.
    """
    zero = min(int(topic.recorded[0]) for topic in topics)
    recorded = [1e-9 * (topic.recorded - zero) for topic in topics]
    begun = min((int(t.stamps[t.stamps != 0][0]) for t in topics if t.stamps.any()), default=0)
    stamps = [np.where(t.stamps != 0, 1e-9 * (t.stamps - begun), np.nan) for t in topics]
    if all(np.ptp(times) == 0 for times in recorded):
        if any(np.isnan(times).any() for times in stamps):
            raise ValueError("the recorder's clock stands still, and messages have no stamps")
        joined, seams = _pieces(topics, stamps, "clock of the stamps")
        return joined, [None] * len(topics), seams
    lacking, jumps = _unstamped(topics, stamps), _jumps(topics, stamps, recorded)
    offsets = [float(np.nanmedian(s - r)) for s, r in zip(stamps, recorded, strict=True)
               if np.isfinite(s).any()]  # fmt: skip
    if not (lacking or jumps or np.ptp(offsets) > APART):
        return stamps, [None] * len(topics), _latencies(topics, stamps, recorded)
    why = lacking or ("the clock of the stamps jumps" if jumps else "the stamps are of two clocks")
    joined, seams = _pieces(topics, recorded, "recorder's clock")
    told = [Finding("clock", Weight.NOTE, f"all topics are timed by the recorder's clock: {why}")]
    first = min(float(times[0]) for times in joined)
    for (word, size), places in jumps.items():
        at = float(joined[places[0][0]][places[0][1]])
        names = ", ".join(dict.fromkeys(topics[topic].name for topic, _ in places))
        sentence = (
            f"{names}: the clock of the stamps is set {word} by {size} s, {at - first:.2f} s into"
            " the recording"
        )
        told.append(Finding(f"clock_{word}", Weight.NOTE, sentence, (), at, at))
    return joined, list(stamps), told + seams


def _unstamped(topics: Sequence[Recorded], stamps: list[Float[np.ndarray, " _"]]) -> str:
    return "; ".join(
        f"{int(np.isnan(own).sum())} of {len(own)} messages of {topic.name} have no stamp"
        for topic, own in zip(topics, stamps, strict=True)
        if np.isnan(own).any()
    )


def _jumps(
    topics: Sequence[Recorded],
    stamps: list[Float[np.ndarray, " _"]],
    recorded: list[Float[np.ndarray, " _"]],
) -> dict[tuple[str, str], list[tuple[int, int]]]:
    """Jumps of the stamps against the recorder's clock: which way and by how much [s], and in which
    topics at which messages."""
    found: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for topic, (own, other) in enumerate(zip(stamps, recorded, strict=True)):
        for k in clock_jumps(own, other).tolist():
            timed = np.flatnonzero(np.isfinite(own[:k]))[-1]
            step, held = float(own[k] - own[timed]), float(other[k] - other[timed])
            # Where both went back, the recorder's step tells nothing of the time that passed.
            size = step - held if held > -JUMP else step
            key = ("back" if size < 0 else "forward", f"{abs(size):.2g}")
            found.setdefault(key, []).append((topic, k))
    return found


def _latencies(
    topics: Sequence[Recorded],
    stamps: list[Float[np.ndarray, " _"]],
    recorded: list[Float[np.ndarray, " _"]],
) -> list[Finding]:
    """Topics whose stamps are older or younger than those of the others when they are recorded."""
    ages = np.array([np.median(r - s) for r, s in zip(recorded, stamps, strict=True)])
    usual = ages[0]
    told = []
    for topic, age in zip(topics, ages - usual, strict=True):
        if abs(age) > JUMP:
            word = "older" if age > 0 else "younger"
            sentence = (
                f"{topic.name}: stamps are {abs(age):.2g} s {word} when they are recorded than"
                f" those of {topics[0].name}: sent late, or of another clock"
            )
            told.append(Finding("latency", Weight.NOTE, sentence))
    return told


def _pieces(
    topics: Sequence[Recorded], clock: list[Float[np.ndarray, " _"]], name: str
) -> tuple[list[Float[np.ndarray, " _"]], list[Finding]]:
    """Times that go on where the clock goes back, and what is told of each such seam.

    A topic that shows fewer jumps than another, for it is slow, is cut where that is in the file.
    """
    cuts = [np.flatnonzero(np.diff(times) < -JUMP) + 1 for times in clock]
    most = int(np.argmax([len(cut) for cut in cuts]))
    if not len(cuts[most]):
        return clock, []
    edges = topics[most].places[cuts[most]]
    piece = []
    for topic, times, cut in zip(topics, clock, cuts, strict=True):
        if len(cut) == len(edges):
            piece.append(np.searchsorted(cut, np.arange(len(times)), side="right"))
        else:
            piece.append(np.searchsorted(edges, topic.places, side="right"))
    joined, told, shift = [times.copy() for times in clock], [], 0.0
    for k in range(1, len(edges) + 1):
        ends = [j[p < k].max() for j, p in zip(joined, piece, strict=True) if (p < k).any()]
        begins = [c[p == k].min() for c, p in zip(clock, piece, strict=True) if (p == k).any()]
        before = shift
        shift = max(ends) + SEAM - min(begins)
        size = before + SEAM - shift
        for j, c, p in zip(joined, clock, piece, strict=True):
            j[p >= k] = c[p >= k] + shift
        sentence = (
            f"the {name} goes back by {-size:.3g} s, {max(ends) - joined[most][0]:.2f} s into the"
            f" recording: it is cut there, and put together {SEAM:g} s apart"
        )
        told.append(
            Finding("clock_back", Weight.LEFT_OUT, sentence, (), float(max(ends)),
                    float(max(ends) + SEAM))
        )  # fmt: skip
    return joined, told
