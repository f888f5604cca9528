"""What times tell: gaps, jumps, rates and ends; and delays of an arm of mass, spring and damper."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_dynamics import COMMAND, POSE, WRENCH, an_arm, parts_of

from tpcd.quality.clocks import check_clocks, check_jumps, clock_jumps
from tpcd.quality.delay import estimate_delays
from tpcd.quality.finding import Finding, Weight, overlapping, usable
from tpcd.quality.stream import Stream, find_gaps, forward, gaps_of


def stream(times: np.ndarray, channels: tuple[str, ...] = WRENCH) -> Stream:
    return Stream("/it", channels, times, np.ones((len(times), len(channels))))


RATES = {
    "1 kHz": np.full(5000, 1e-3),
    "100 Hz": np.full(1000, 1e-2),
    "10 Hz": np.full(300, 0.1),
    "1 Hz": np.full(60, 1.0),
    "two rates": np.concatenate((np.full(2000, 1e-3), np.full(200, 0.1), np.full(2000, 1e-3))),
    "bursts of seven": np.tile([1e-4] * 6 + [0.0694], 200),
    "jitter": np.random.default_rng(1).uniform(2e-3, 18e-3, 2000),
    "few": np.full(6, 0.01),
}


@pytest.mark.parametrize("rate", RATES)
def test_the_spacing_of_a_stream_is_no_gap(rate: str) -> None:
    times = np.concatenate(([0.0], np.cumsum(RATES[rate])))
    assert len(find_gaps(times)) == 0


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("where", [0.0, 0.37, 1.0])
def test_several_spacings_without_a_sample_are_a_gap_wherever_they_are(
    rate: str, where: float
) -> None:
    spacings = RATES[rate].copy()
    place = min(int(where * len(spacings)), len(spacings) - 1)
    seconds = max(0.2, 10 * np.quantile(spacings, 0.95))
    spacings[place] = seconds
    times = np.concatenate(([0.0], np.cumsum(spacings)))
    assert np.allclose(find_gaps(times), [[times[place], times[place + 1]]])


@settings(max_examples=30)
@given(st.lists(st.floats(1e-4, 5.0), min_size=1, max_size=200), st.floats(-1e3, 1e3))
def test_gaps_do_not_depend_on_when_a_recording_began(spacings: list[float], since: float) -> None:
    times = np.concatenate(([0.0], np.cumsum(spacings)))
    # To the 1e-12 s that adding costs, no spacing may stand on the limit.
    assert len(find_gaps(times)) == len(find_gaps(times * 1.0))
    assert np.allclose(find_gaps(times + 2.0**20) - 2.0**20, find_gaps(times), atol=1e-6)


def test_samples_without_numbers_are_a_gap() -> None:
    times = np.arange(1000) / 100
    values = np.ones((1000, 3))
    values[300:520, 1] = np.nan
    (gap,) = (f for f in check_clocks([Stream("/ft", WRENCH, times, values)]) if f.kind == "gap")
    assert gap.weight is Weight.LEFT_OUT and (gap.start, gap.end) == (2.99, 5.2)
    assert gap.sentence.startswith("/ft: no wrench from 2.99 to 5.20 s")
    kept = usable(times, [gap])
    assert not kept[300:520].any() and kept[:299].all() and kept[521:].all()
    # A stretch that only touches the gap is whole; one that lies inside, where nothing is, is not.
    assert not overlapping(5.2, 6.0, [gap]) and overlapping(3.5, 3.6, [gap])


def test_silence_of_set_points_is_a_gap_only_of_a_sender_that_says_them_again() -> None:
    times = np.delete(np.arange(1000) / 100, np.arange(300, 520))
    again = Stream("/to", COMMAND, times, np.repeat(np.arange(78), 10)[:, None] * np.ones(3))
    once = Stream("/to", COMMAND, times, np.arange(780)[:, None] * np.ones(3))
    assert np.allclose(gaps_of(again), [[2.99, 5.2]])
    assert len(gaps_of(once)) == 0
    pose = stream(np.arange(2000) / 100, POSE)
    ends = [[f.kind for f in check_clocks([pose, part])] for part in (again, once)]
    assert "early_end" in ends[0] and "early_end" not in ends[1]


def test_samples_too_rare_to_know_rest_by_are_doubted_or_gaps() -> None:
    rare, often = stream(np.arange(60.0)), stream(np.arange(0.0, 59.0, 0.01))
    assert {f.weight for f in check_clocks([rare, often]) if f.kind == "rate"} == {
        Weight.DOUBT, Weight.NOTE,
    }  # fmt: skip
    assert len(find_gaps(3.0 * np.arange(60.0))) == 59


def test_what_is_sampled_together_however_rarely_has_no_gaps_but_where_it_stops() -> None:
    times = 10.0 * np.arange(60.0)
    assert [f.kind for f in check_clocks([stream(times)])] == ["rate"]
    times[30:] += 60.0
    gaps = [f for f in check_clocks([stream(times)]) if f.kind == "gap"]
    assert [(f.start, f.end) for f in gaps] == [(290.0, 360.0)]


def test_short_stretches_without_numbers_are_none() -> None:
    times = np.arange(1000) / 100
    values = np.ones((1000, 3))
    values[300:303] = np.nan
    assert not [f for f in check_clocks([Stream("/ft", WRENCH, times, values)]) if f.kind == "gap"]


def test_a_clock_that_goes_back_is_named_with_size_and_time() -> None:
    times = np.concatenate((np.arange(0.0, 5.0, 0.01), np.arange(2.0, 6.0, 0.01)))
    (found,) = check_jumps(stream(times))
    assert found.weight is Weight.SERIOUS and "from 4.99 to 2 s" in found.sentence
    assert check_jumps(stream(times[:400])) == []
    late = np.arange(0.0, 5.0, 0.01)
    late[100:102] = late[[101, 100]]
    assert check_jumps(stream(late)) == [] and (~forward(late)).sum() == 1


@pytest.mark.parametrize("size", [-40.0, -3.0, -0.2, 0.2, 3.0])
def test_of_two_clocks_the_one_that_jumped_is_at_fault(size: float) -> None:
    random = np.random.default_rng(0)
    recorded = np.arange(0.0, 20.0, 0.01) + random.uniform(0, 0.004, 2000)
    stamps = np.arange(0.0, 20.0, 0.01)
    stamps[700:] += size
    assert clock_jumps(stamps, recorded).tolist() == [700]
    if size > 0:
        assert clock_jumps(recorded, stamps).tolist() == []
    stalled = np.arange(0.0, 20.0, 0.01)
    stalled[500:550] = stalled[549]
    assert clock_jumps(np.arange(0.0, 20.0, 0.01), stalled).tolist() == []


def test_what_is_missing_at_either_end_is_left_out() -> None:
    times = np.arange(1000) / 100
    command = Stream("/to", COMMAND, times[100:900], np.arange(800.0)[:, None] * np.ones(3))
    parts = [stream(times, POSE), stream(times[200:700]), command]
    told = {(each.kind, *each.channels[:1]): each for each in check_clocks(parts)}
    assert told["late_start", "F_x"].end == 2.0 and told["late_start", "u_x"].end == 1.0
    assert told["early_end", "F_x"].start == 6.99
    assert ("early_end", "u_x") not in told
    left = [each for each in told.values() if each.weight is Weight.LEFT_OUT]
    assert usable(times, left).sum() == 498


ARM = an_arm(300.0, 4.0, 0)


@pytest.mark.parametrize("wrench", [0.0, 0.3, -0.3])
@pytest.mark.parametrize("command", [0.0, 0.25, -0.2])
def test_delays_of_wrench_and_set_point_are_told_apart(wrench: float, command: float) -> None:
    parts = parts_of(ARM, wrench, command)
    found = {each.of: each for each in estimate_delays(parts)}
    for name, true in (("wrench", wrench), ("command", command)):
        assert found[name].known and found[name].value == pytest.approx(true, abs=0.03)
        assert found[name].doubtful == (true != 0.0)
    doubts = [f for f in check_clocks(parts) if f.weight is Weight.DOUBT]
    assert len(doubts) == (wrench != 0.0) + (command != 0.0)
    assert all("if their clocks differ, give --delay" in doubt.remedy for doubt in doubts)


def test_two_in_three_intervals_hold_the_delay() -> None:
    # Two standard errors hold 95 %: of nine, fewer than six is as rare as 2 in 10,000.
    held = 0
    for seed, (stiffness, mass) in enumerate(((1000.0, 3.0), (100.0, 5.0), (30.0, 6.0))):
        arm = an_arm(stiffness, mass, seed, 20)
        for delay in (-0.2, 0.0, 0.4):
            (found,) = (e for e in estimate_delays(parts_of(arm, delay)) if e.of == "wrench")
            held += found.known and found.low <= delay <= found.high
    assert held >= 6


def test_a_turned_sensor_of_another_sign_and_gain_changes_no_delay() -> None:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix()
    arm = {**ARM, "wrench": -3.0 * ARM["wrench"] @ turn.T + 7.0}
    (found,) = (each for each in estimate_delays(parts_of(arm, 0.3)) if each.of == "wrench")
    assert found.value == pytest.approx(0.3, abs=0.03)


def test_without_contact_motion_or_set_points_no_delay_is_claimed() -> None:
    random = np.random.default_rng(0)
    free = {**ARM, "wrench": 0.1 * random.standard_normal(ARM["wrench"].shape)}
    still = {**ARM, "pose": ARM["pose"][:1] + 1e-4 * random.standard_normal(ARM["pose"].shape),
             "command": 0 * ARM["command"]}  # fmt: skip
    for arm in (free, still):
        assert not any(each.doubtful for each in estimate_delays(parts_of(arm)))
        told = [each for each in check_clocks(parts_of(arm)) if each.kind == "delay"]
        assert all(each.weight is Weight.NOTE for each in told)
    assert not any(each.known for each in estimate_delays(parts_of(free)))
    assert estimate_delays(parts_of(ARM)[:2]) == ()


def test_findings_tell_their_remedy() -> None:
    assert str(Finding("gap", Weight.NOTE, "so it is", remedy="do this")) == "so it is; do this"
