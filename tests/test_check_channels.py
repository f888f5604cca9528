"""Frozen, clipped and spiked channels are named by channel and time, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_streams import TURNED, WRENCH, alarms, changed, frozen, made_stream
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from tpcd.quality.channels import check_channels
from tpcd.quality.finding import Finding, Weight, usable
from tpcd.quality.stream import Stream
from tpcd.quality.units import check_units

SENSORS = [(0.0, 0.0), (1e-3, 0.0), (1.0, 0.0), (1.0, 0.3), (1.0, 1.0), (1.0, 3.0), (1.0, 10.0),
           (0.0, 1.0), (0.1, 3.0), (3.0, 0.03)]  # fmt: skip
"""Noise and resolution, in standard deviations of a usual sensor."""


def found(stream: Stream, kind: str, name: str) -> list[Finding]:
    return [f for f in check_channels([stream]) if f.kind == kind and name in f.channels]


@pytest.mark.parametrize(("noise", "steps"), SENSORS)
def test_a_clean_recording_raises_no_alarm(noise: float, steps: float) -> None:
    # 10 sensors x 4 seeds x 11 channels: fewer than 1 % of channels, with 99 % certainty.
    for seed in range(4):
        stream = made_stream(noise, steps, seed)
        assert alarms(check_channels([stream])) == [] and check_units([stream]) == ()


@pytest.mark.parametrize(
    ("noise", "steps", "shortest"),
    [(1e-3, 0.0, 10), (1.0, 0.0, 10), (1.0, 0.3, 15), (1.0, 1.0, 80)],
)
def test_a_frozen_channel_is_named_with_its_time(noise: float, steps: float, shortest: int) -> None:
    random = np.random.default_rng(7)
    hits, elsewhere, tries = 0, 0, 0
    for seed in range(8):
        for length in (shortest, 3 * shortest, 20 * shortest):
            stream = made_stream(noise, steps, seed)
            name = str(random.choice(["F_x", "F_z", "T_y"]))
            first = int(random.integers(50, len(stream.times) - length - 50))
            told = alarms(check_channels([frozen(stream, (name,), first, first + length)]))
            # Where readings come in steps, a few samples before and after may be the same.
            own = [
                f
                for f in told
                if f.kind == "frozen" and f.channels == (name,) and f.rows is not None
                if first - 9 <= f.rows[0] <= first and 0 <= f.rows[1] - first - length <= 9
            ]
            hits, elsewhere, tries = hits + bool(own), elsewhere + len(told) - len(own), tries + 1
            for each in own:
                assert each.weight is Weight.LEFT_OUT and each.start is not None
                assert abs(each.start - stream.times[first]) < 0.1
    assert hits >= 0.9 * tries and elsewhere == 0


def test_a_sensor_that_freezes_whole_is_one_finding() -> None:
    stream = made_stream()
    (told,) = alarms(check_channels([frozen(stream, WRENCH, 2000, 2300)]))
    assert told.kind == "frozen" and told.channels == WRENCH and told.rows == (2000, 2300)
    kept = usable(stream.times, [told])
    assert not kept[2000:2300].any() and kept[:1999].all() and kept[2301:].all()


def test_a_sensor_that_dies_is_frozen_to_the_end() -> None:
    stream = made_stream()
    (told,) = alarms(check_channels([frozen(stream, WRENCH, 2500, len(stream.times))]))
    assert told.rows == (2500, len(stream.times))


def test_an_arm_without_noise_that_stands_still_is_not_frozen() -> None:
    times = np.arange(6000) / 100.0
    moving = np.where((times > 5) & (times < 50), np.sin(times - 5.0), 0.0)
    moving[times >= 50] = np.sin(45.0)
    noisy = np.random.default_rng(0).normal(size=len(times))
    stream = Stream("made", ("x", "z", "F_x"), times, np.column_stack((moving, moving**2, noisy)))
    assert alarms(check_channels([stream])) == []


def test_a_channel_without_noise_is_frozen_where_it_comes_back_with_a_jump() -> None:
    stream = made_stream(noise=0.0)
    place = stream.channels.index("z")
    moves = np.abs(np.diff(stream.values[:, place]))
    first = int(np.argmax(moves)) - 50
    told = found(frozen(stream, ("z",), first, first + 400), "frozen", "z")
    assert [f.rows for f in told] == [(first, first + 400)]


@pytest.mark.parametrize("every", [2, 5, 20])
def test_a_sensor_that_is_updated_seldom_is_not_frozen(every: int) -> None:
    stream = made_stream()
    values = stream.values.copy()
    held = np.arange(len(values)) // every * every
    values[:, 7:13] = values[held, 7:13]
    slow = replace(stream, values=values)
    told = check_channels([slow])
    assert alarms(told) == []
    noted = [f.sentence for f in told if f.kind == "slow" and f.channels == ("F_z",)]
    assert noted == [f"F_z is updated with every {every}th sample only"]
    (own,) = alarms(check_channels([frozen(slow, ("F_z",), 2000, 2000 + 30 * every)]))
    assert own.channels == ("F_z",)


@pytest.mark.parametrize("memory", [0.5, 0.9, 0.98])
def test_filtered_noise_is_not_frozen(memory: float) -> None:
    random = np.random.default_rng(3)
    white = random.normal(size=(20000, 3))
    noise = np.asarray(lfilter([1.0 - memory], [1.0, -memory], white, axis=0))
    for digits in (2, 3, 9):
        stream = Stream("made", ("F_x", "F_y", "F_z"), np.arange(20000) / 500, noise.round(digits))
        assert alarms(check_channels([stream])) == []


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("part", [0.6, 0.9, 0.98])
def test_a_channel_at_the_end_of_its_range_is_clipped(side: float, part: float) -> None:
    for seed, steps in enumerate((0.0, 0.03, 0.3)):
        stream = made_stream(1.0, steps, seed)
        column = stream.channels.index("F_x")
        limit = float(np.quantile(side * stream.values[:, column], part))
        values = stream.values.copy()
        values[:, column] = side * np.minimum(side * values[:, column], limit)
        cut = np.flatnonzero(values[:, column] == side * limit)
        told = found(replace(stream, values=values), "clipped", "F_x")
        covered = np.zeros(len(values), dtype=bool)
        for each in told:
            assert each.weight is Weight.LEFT_OUT and each.rows is not None
            covered[slice(*each.rows)] = True
        assert covered[cut].all() and covered.sum() < 1.5 * len(cut) + 100


@pytest.mark.parametrize(
    ("side", "part", "scatter"),
    [(1.0, 0.95, 0.02), (-1.0, 0.6, 0.02), (-1.0, 0.8, 0.01), (-1.0, 0.95, 0.02)],
)
def test_a_limit_with_noise_on_top_is_clipped(side: float, part: float, scatter: float) -> None:
    stream = made_stream()
    column = stream.channels.index("F_x")
    limit = float(np.quantile(side * stream.values[:, column], part))
    values = stream.values.copy()
    values[:, column] = side * np.minimum(side * values[:, column], limit)
    at_end = values[:, column] == side * limit
    values[:, column] += scatter * np.random.default_rng(2).normal(size=len(values))
    told = found(replace(stream, values=values), "clipped", "F_x")
    covered = np.zeros(len(values), dtype=bool)
    for each in told:
        assert each.weight is Weight.LEFT_OUT and each.rows is not None
        covered[slice(*each.rows)] = True
    assert covered[at_end].mean() > 0.9 and covered.sum() < 3 * at_end.sum() + 100


def test_quiet_free_air_between_presses_that_chatter_is_no_limit() -> None:
    random = np.random.default_rng(4)
    times = np.arange(6000) / 100.0
    pressed = (times % 10.0 > 4.0)[:, None] * (3.0 + random.normal(0.0, 0.4, (6000, 3)))
    values = pressed + random.normal(0.0, 0.02, (6000, 3))
    stream = Stream("made", ("F_x", "F_y", "F_z"), times, values)
    assert alarms(check_channels([stream])) == []


@pytest.mark.parametrize("digits", [3, 9])
def test_a_wrench_that_froze_in_the_sensor_and_turned_with_the_hand_is_frozen(digits: int) -> None:
    stream = made_stream()
    turns = Rotation.from_quat(stream.values[:, 3:7])
    values = stream.values.copy()
    values[2000:2300, 7:13] = values[2000, 7:13]
    for part in (slice(7, 10), slice(10, 13)):
        values[:, part] = turns.apply(values[:, part]).round(digits)
    told = alarms(check_channels([replace(stream, values=values)]))
    assert {name for each in told for name in each.channels} == set(WRENCH) - {"tau"}
    assert any("turned with the hand" in each.sentence for each in told)
    out = ~usable(stream.times, told)
    assert out[2000:2300].all() and out.sum() < 305
    values[2000:2300, 7:13] = stream.values[2000:2300, 7:13]
    assert alarms(check_channels([replace(stream, values=values)])) == []


def test_a_spike_is_one_sample_and_a_step_is_none() -> None:
    for name, size in (("z", 0.05), ("F_z", 8.0), ("T_y", -1.0)):
        stream = made_stream()
        value = stream.values[700, stream.channels.index(name)] + size
        (told,) = alarms(check_channels([changed(stream, name, 700, 701, value)]))
        assert (told.kind, told.channels, told.rows) == ("spike", (name,), (700, 701))
        assert not usable(stream.times, [told])[699:702].any()
        stepped = changed(
            stream, name, 700, 5510, stream.values[700:, stream.channels.index(name)] + size
        )
        assert alarms(check_channels([stepped])) == []


def test_samples_without_a_number_are_listed_by_rows() -> None:
    stream = changed(changed(made_stream(), "F_z", 10, 13, np.nan), "F_z", 99, 100, np.nan)
    (told,) = (f for f in check_channels([stream]) if f.kind == "missing")
    assert "4 of 5510" in told.sentence and "rows 10 to 12, 99;" in told.sentence


def test_a_channel_that_never_changes_is_noted() -> None:
    stream = changed(made_stream(), "T_z", 0, 5510, 0.25)
    assert [f.channels for f in check_channels([stream]) if f.kind == "constant"] == [("T_z",)]


def test_streams_of_several_clocks_are_checked_each_by_itself() -> None:
    stream = made_stream(setting=TURNED)
    pose = Stream("pose", stream.channels[:7], stream.times[::2], stream.values[::2, :7])
    wrench = Stream("wrench", stream.channels[7:13], stream.times, stream.values[:, 7:13])
    (told,) = alarms(check_channels([pose, frozen(wrench, ("F_y",), 800, 900)]))
    assert told.channels == ("F_y",) and told.start == pytest.approx(8.0)


def test_an_angle_that_begins_again_at_a_full_turn_has_no_spikes() -> None:
    random, times = np.random.default_rng(0), np.arange(2000) / 100.0
    angle = 0.5 + 0.4975 * np.sin(times) + 1e-3 * random.standard_normal(len(times))
    place = 0.1 * np.sin(times) + 1e-4 * random.standard_normal(len(times))
    values = np.column_stack((place, np.remainder(angle, 2.0 * np.pi)))
    assert not alarms(check_channels([Stream("made", ("x", "phi"), times, values)]))
