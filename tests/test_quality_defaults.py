"""Samples that a driver fills in where it read nothing, and readings that only look so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_streams import POSE, WRENCH, made_stream

from tpcd.logs.joining import join
from tpcd.quality.defaults import find_defaults
from tpcd.quality.stream import Stream, role

FILLED = {"wrench": np.zeros(6), "pose": np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])}


def part(stream: Stream, names: tuple[str, ...]) -> Stream:
    columns = [stream.channels.index(name) for name in names]
    return replace(stream, channels=names, values=stream.values[:, columns])


def filled(stream: Stream, share: float, burst: int) -> tuple[Stream, np.ndarray]:
    """The stream with what is filled in for a share of its samples, and which those are."""
    random = np.random.default_rng(1)
    begun = random.random(len(stream.times)) < share / burst
    lost = np.convolve(begun, np.ones(burst))[: len(begun)] > 0
    vector = FILLED[role(stream)]
    return replace(stream, values=np.where(lost[:, None], vector, stream.values)), lost


@pytest.mark.parametrize("names", [POSE, WRENCH], ids=["pose", "wrench"])
@pytest.mark.parametrize("steps", [0.0, 0.5])
@pytest.mark.parametrize(("share", "burst"), [(0.02, 1), (0.3, 1), (0.1, 6)])
def test_what_is_filled_in_is_found_and_hardly_anything_else(names, steps, share, burst) -> None:
    stream, lost = filled(part(made_stream(steps=steps), names), share, burst)
    found = find_defaults(stream)
    # A reading in free air may be rounded to nothing in all channels, too.
    assert found[lost].all() and (found & ~lost).mean() <= 0.02 * (steps > 0)


@pytest.mark.parametrize("names", [POSE, WRENCH], ids=["pose", "wrench"])
@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("steps", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("dead", [0.0, 2.0])
def test_readings_are_not_filled_in(names, noise, steps, dead) -> None:
    stream = part(made_stream(noise, steps), names)
    if names == WRENCH:
        size = dead * np.array([0.2] * 3 + [0.01] * 3)
        stream = replace(stream, values=np.where(np.abs(stream.values) < size, 0, stream.values))
    assert not find_defaults(stream).any()


def test_an_import_leaves_them_out_and_tells_them() -> None:
    whole = made_stream()
    wrench, lost = filled(part(whole, WRENCH), 0.2, 1)
    log = join(Path("made.csv"), [part(whole, POSE), replace(wrench, name="/ft")])
    assert len(log) == (~lost).sum() and np.abs(log.forces).sum(1).min() > 0
    assert any(f"{lost.sum()} samples of /ft hold (0, 0, 0, 0, 0, 0)" in n for n in log.notes)
