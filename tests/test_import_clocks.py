"""Clocks that are set, stand still or are missing, and streams that stop: no row is mixed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_bags import BEGIN, KINDS, TOPICS, write_bag
from made_logs import HOLD, RAMP, Setting, an_episode, choices_of, in_space, sampled

from tpcd.data.episode import Episode
from tpcd.logs.bags import read_bag
from tpcd.logs.importing import Imported, import_log
from tpcd.logs.joining import parse_delays
from tpcd.logs.log import Log, LogError
from tpcd.quality.finding import Weight

EPISODE = an_episode(8)
SPACE = in_space(sampled(EPISODE), Setting())
STEP = HOLD + RAMP
SET = 8.1
"""When a clock is set [s]: within the fifth hold, before its window."""


def imported(log: Log) -> Imported:
    """The import, of which every row is one of the episode, with its own pose and wrench."""
    found = import_log(log, choices_of(Setting(), plane=plane()))
    content = found.content
    assert isinstance(content, Episode)
    for k in range(1, len(content)):
        away = (EPISODE.commands - content.commands[k]).abs().amax(-1)
        same = int(away.argmin())
        assert float(away[same]) < 1e-6
        assert float((content.poses[k] - EPISODE.poses[same]).abs().max()) < 1e-3
        assert float((content.wrenches[k] - EPISODE.wrenches[same]).abs().max()) < 0.2
    return found


def plane():
    return choices_of(Setting()).plane


def kinds(log: Log, *weights: Weight) -> list[str]:
    return [each.kind for each in log.findings if not weights or each.weight in weights]


def set_at(time: float, by: float, since: float = SET) -> float:
    return BEGIN + time + (by if time >= since else 0.0)


@pytest.mark.parametrize("by", [-3.0, -12.0, 3.0, 3600.0])
@pytest.mark.parametrize("kind", KINDS)
def test_stamps_that_jump_are_not_taken_for_times(kind: str, by: float, tmp_path: Path) -> None:
    path = write_bag(kind, tmp_path / "a", SPACE, stamp=lambda role, time: set_at(time, by))
    log = read_bag(path)
    assert len(imported(log).settled.rows) == len(EPISODE)
    (jump,) = (
        each for each in log.findings if each.kind == f"clock_{'back' if by < 0 else 'forward'}"
    )
    assert all(topic in jump.sentence for topic in TOPICS.values())
    assert f"by {abs(by):.2g} s" in jump.sentence and jump.start == pytest.approx(SET, abs=0.06)
    assert kinds(log, Weight.LEFT_OUT) == []


@pytest.mark.parametrize("stamped", [True, False], ids=["both", "recorder alone"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_is_cut_where_no_clock_goes_on(
    kind: str, stamped: bool, tmp_path: Path
) -> None:
    path = write_bag(
        kind,
        tmp_path / "a",
        SPACE,
        stamp=lambda role, time: set_at(time, -3.0) if stamped else None,
        recorder=lambda role, time: set_at(time, -3.0),
    )
    log = read_bag(path)
    assert len(imported(log).settled.rows) == len(EPISODE)
    (cut,) = (each for each in log.findings if each.weight is Weight.LEFT_OUT)
    assert cut.kind == "clock_back" and "goes back by 2.99 s" in cut.sentence
    assert cut.start == pytest.approx(SET, abs=0.03) and cut.end == pytest.approx(SET + 1, abs=0.03)
    assert (np.diff(log.times) > 0).all()


def test_a_row_spans_no_cut(tmp_path: Path) -> None:
    within = 5 * STEP - 0.25
    path = write_bag(
        "ros2",
        tmp_path / "a",
        SPACE,
        stamp=lambda role, time: None,
        recorder=lambda role, time: set_at(time, -3.0, within),
    )
    found = imported(read_bag(path))
    assert len(found.settled.rows) == len(EPISODE) - 1 and len(found.settled.broken) == 1


def test_a_recorder_that_jumps_leaves_good_stamps_alone(tmp_path: Path) -> None:
    for name, by in (("a", -3.0), ("b", 3.0)):
        path = write_bag(
            "ros2", tmp_path / name, SPACE, recorder=lambda role, time, by=by: set_at(time, by)
        )
        log = read_bag(path)
        assert len(imported(log).settled.rows) == len(EPISODE)
        assert kinds(log, Weight.LEFT_OUT, Weight.DOUBT, Weight.SERIOUS) == []


def test_what_the_network_delays_or_reorders_is_no_jump(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    # Stamps out of order by up to 8 ms, and a recorder that stalls for half a second.
    path = write_bag(
        "ros2",
        tmp_path / "a",
        SPACE,
        stamp=lambda role, time: BEGIN + time + random.uniform(-0.008, 0.008),
        recorder=lambda role, time: BEGIN + (max(time, 6.5) if 6.0 < time < 6.5 else time),
    )
    log = read_bag(path)
    assert len(imported(log).settled.rows) == len(EPISODE)
    assert not any(kind.startswith("clock") for kind in kinds(log))
    assert any("samples come late and are left out" in note for note in log.notes)


def test_messages_without_stamps_make_the_recorder_the_clock(tmp_path: Path) -> None:
    # The sender's clock is 100 s off, so that times of both kinds cannot be mixed.
    path = write_bag(
        "ros1",
        tmp_path / "a",
        SPACE,
        stamp=lambda role, time: None if role == "command" or time < 0.5 else BEGIN + time + 100.0,
    )
    log = read_bag(path)
    assert len(imported(log).settled.rows) == len(EPISODE)
    (told,) = (each for each in log.findings if each.kind == "clock")
    assert "of /target_pose have no stamp" in told.sentence and "of /tcp_pose" in told.sentence


def test_stamps_of_two_clocks_are_not_taken(tmp_path: Path) -> None:
    # The sensor counts from when it was switched on.
    path = write_bag(
        "mcap", tmp_path / "a", SPACE,
        stamp=lambda role, time: time + 77.0 if role == "wrench" else BEGIN + time,
    )  # fmt: skip
    log = read_bag(path)
    assert len(imported(log).settled.rows) == len(EPISODE)
    assert any("the stamps are of two clocks" in each.sentence for each in log.findings)


def test_stamps_are_enough_where_the_recorder_kept_no_time(tmp_path: Path) -> None:
    path = write_bag("ros2", tmp_path / "a", SPACE, recorder=lambda role, time: BEGIN)
    assert len(imported(read_bag(path)).settled.rows) == len(EPISODE)
    path = write_bag(
        "ros2", tmp_path / "b", SPACE, stamp=lambda role, time: None,
        recorder=lambda role, time: BEGIN,
    )  # fmt: skip
    with pytest.raises(LogError, match="stands still, and messages have no stamps"):
        read_bag(path)


@pytest.mark.parametrize("silent", ["wrench", "pose"])
@pytest.mark.parametrize("seconds", [0.3, 1.2, 8.0])
def test_no_line_is_drawn_over_a_gap(silent: str, seconds: float, tmp_path: Path) -> None:
    begin = 3 * STEP - 0.2
    path = write_bag(
        "ros2", tmp_path / "a", SPACE,
        keep=lambda role, time: role != silent or not begin < time < begin + seconds,
    )  # fmt: skip
    log = read_bag(path)
    found = imported(log)
    assert not ((log.times > begin + 0.01) & (log.times < begin + seconds - 0.01)).any()
    (gap,) = (each for each in log.findings if each.weight is Weight.LEFT_OUT)
    assert gap.kind == "gap" and gap.start is not None and gap.end is not None
    assert gap.start == pytest.approx(begin, abs=0.02)
    assert gap.end == pytest.approx(begin + seconds, abs=0.02)
    assert TOPICS[silent] in gap.sentence and silent in gap.sentence
    # A hold of which the end is not there makes a row if it was settled before the gap.
    within = [k for k in range(len(EPISODE)) if begin < k * STEP + 0.5 < begin + seconds]
    assert len(found.settled.rows) >= len(EPISODE) - len(within) - 1
    ends = log.times[found.settled.stretches[:, 1] - 1]
    assert not ((ends - 0.5 < gap.end - 0.01) & (ends > gap.start + 0.01)).any()


def test_set_points_hold_until_the_next_one_comes(tmp_path: Path) -> None:
    # Published when they change, and never in between.
    change = np.abs(np.diff(SPACE["target"], axis=0)).max(1) > 0
    sent = {round(t, 4) for t in SPACE["time"][1:][change].tolist()} | {0.0}
    path = write_bag(
        "ros2", tmp_path / "a", SPACE, keep=lambda role, time: role != "command" or
        round(time, 4) in sent or round(time % STEP, 2) == RAMP,
    )  # fmt: skip
    log = read_bag(path)
    assert len(imported(log).settled.rows) == len(EPISODE)
    assert kinds(log, Weight.LEFT_OUT) == []


@pytest.mark.parametrize(("end", "rows"), [(5.5, 8), (9.3, 7), (100.0, 2)])
def test_a_sender_that_says_its_set_point_again_and_falls_silent_holds_nothing(
    end: float, rows: int, tmp_path: Path
) -> None:
    # The arm goes on to set points that nobody recorded: at the end of the silence it rests
    # elsewhere than at the last one known.
    path = write_bag(
        "ros2",
        tmp_path / "a",
        SPACE,
        keep=lambda role, time: role != "command" or not 5.0 < time < end,
    )
    log = read_bag(path)
    found = imported(log)
    assert len(found.settled.rows) == rows
    assert {each.kind for each in log.findings if each.weight is Weight.LEFT_OUT} == {
        "early_end" if end == 100.0 else "gap"
    }


def test_what_comes_before_the_first_and_after_the_last_is_told(tmp_path: Path) -> None:
    path = write_bag(
        "ros2", tmp_path / "a", SPACE,
        keep=lambda role, time: time > 1.0 if role == "command" else
        role == "pose" or time < 7 * STEP + 0.8,
    )  # fmt: skip
    log = read_bag(path)
    found = imported(log)
    assert len(found.settled.rows) == 7
    told = {each.kind: each.sentence for each in log.findings if each.weight is Weight.LEFT_OUT}
    assert "the first command comes 1" in told["late_start"]
    assert "no wrench comes in the last" in told["early_end"]


def test_zero_quaternions_are_left_out_and_told_like_other_samples_without_numbers(
    tmp_path: Path,
) -> None:
    space = {**SPACE, "rotation": SPACE["rotation"].copy()}
    space["rotation"][200:203] = 0.0
    begin = round(3 * STEP * 100) - 40
    space["rotation"][begin : begin + 20] = 0.0
    log = read_bag(write_bag("ros2", tmp_path / "a", space))
    found = imported(log)
    assert len(found.settled.rows) == len(EPISODE) - 1 and len(found.settled.broken) == 1
    (gap,) = (each for each in log.findings if each.weight is Weight.LEFT_OUT)
    assert gap.kind == "gap" and gap.start == pytest.approx(3 * STEP - 0.4, abs=0.03)
    assert any("23 samples of /tcp_pose have a quaternion of length 0" in n for n in log.notes)


def test_streams_of_different_clocks_are_told_and_mended_on_request(tmp_path: Path) -> None:
    episode = an_episode(20)
    space = in_space(sampled(episode), Setting())
    early = write_bag(
        "ros2", tmp_path / "a", space,
        stamp=lambda role, time: BEGIN + time - (0.3 if role == "wrench" else 0.0),
        recorder=lambda role, time: BEGIN + time - (0.3 if role == "wrench" else 0.0),
    )  # fmt: skip
    log = read_bag(early)
    (told,) = (
        each for each in log.findings if each.kind == "delay" and each.weight is Weight.DOUBT
    )
    assert "the wrench is 0.2" in told.sentence and "s early against the pose" in told.sentence
    assert "--delay wrench=-0." in told.remedy
    dropped = len(import_log(log, choices_of(Setting())).settled.rows)
    for delays in (("wrench=-0.3",), ("auto",)):
        mended = read_bag(early, delays=parse_delays(delays))
        assert len(import_log(mended, choices_of(Setting())).settled.rows) == len(episode) > dropped
        assert "moved" in kinds(mended) and not kinds(mended, Weight.DOUBT)
    for bad in ("wrench", "wrench=x", "force=1", "wrench=inf"):
        with pytest.raises(ValueError, match="expected auto, pose=SECONDS"):
            parse_delays((bad,))
