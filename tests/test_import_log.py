"""Importing recordings: whatever frame, sign and sensor they come with, the episode is the same."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from made_logs import (
    HOLD,
    RAMP,
    RATE,
    SAMPLE_STD,
    STIFFNESS,
    Setting,
    an_episode,
    choices_of,
    log_of,
    sampled,
)
from scipy.spatial.transform import Rotation

from tpcd.data.episode import Episode
from tpcd.data.files import read_episode, write_together
from tpcd.data.measured import Measured, NoCommandsError, read_measured
from tpcd.logs.columns import log_from_columns
from tpcd.logs.importing import Importing, import_log
from tpcd.logs.log import LogError
from tpcd.logs.plane import Plane, WrenchReading, project
from tpcd.logs.settled import Stillness, find_holds, find_settled
from tpcd.quality.finding import Finding, Weight

WINDOW_SAMPLES = 51
ROW_STD = np.array(SAMPLE_STD) / math.sqrt(WINDOW_SAMPLES)
EPISODE = an_episode()
SAMPLES = sampled(EPISODE)
angles = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
lengths = st.tuples(*[st.floats(-0.3, 0.3)] * 3)
TURNED = Setting(
    base=Rotation.from_euler("xyz", [0.3, 0.5, 2.0]),
    tool=Rotation.from_euler("xyz", [3.0, 0.2, 0.1]),
    origin=(0.4, -0.2, 0.1),
    point=(0.01, 0.02, -0.05),
    in_tool=True,
    sign=-1.0,
)


def check_rows(rows: np.ndarray, left_out: np.ndarray) -> None:
    """Rows of settled poses, commands and wrenches are those of the episode."""
    expected = torch.cat((EPISODE.poses, EPISODE.commands, EPISODE.wrenches), 1).numpy()
    wrong = np.abs(rows - expected)
    # Five standard errors of a mean, and what is left of the approach.
    assert (wrong[:, :3].max(0) < 5 * ROW_STD[:3] + 1e-7).all()
    assert wrong[1:, 3:6].max() < 1e-9
    assert (wrong[:, 6:].max(0) < 5 * ROW_STD[3:] + 1e-4).all()
    assert np.allclose(left_out, 0.0, atol=1e-9)


@settings(max_examples=15)
@given(
    base=angles,
    tool=angles,
    origin=lengths,
    point=lengths,
    in_tool=st.booleans(),
    sign=st.sampled_from([-1.0, 1.0]),
)
def test_the_rows_are_the_same_in_every_frame(base, tool, origin, point, in_tool, sign) -> None:
    turns = (Rotation.from_euler("xyz", list(a)) for a in (base, tool))
    setting = Setting(*turns, origin, point, in_tool, sign)
    choices = choices_of(setting)
    planar = project(log_of(setting, SAMPLES), choices.plane, choices.wrench)
    found = find_settled(planar, choices.stillness)
    assert found.commands is not None
    rows = np.column_stack((found.rows[:, :3], found.commands, found.rows[:, 3:]))
    check_rows(rows, planar.motion_left_out)


@pytest.mark.parametrize("setting", [Setting(), TURNED, replace(TURNED, in_tool=False)])
def test_the_episode_is_the_same_in_every_frame_and_without_doubts(setting) -> None:
    found = import_log(log_of(setting, SAMPLES), choices_of(setting))
    content = found.content
    assert isinstance(content, Episode) and found.account.doubts == ()
    rows = torch.cat((content.poses, content.commands, content.wrenches), 1).numpy()
    check_rows(rows, found.planar.motion_left_out)


@pytest.mark.parametrize(
    ("frame", "sign", "expected"),
    [
        ("tool", 1.0, "the wrench is inverted: then K (x - u) would leave 1% of force"),
        ("world", -1.0, "the wrench is given in tool axes: then K (x - u) would leave 1% of"),
        ("world", 1.0, "the wrench is inverted and the wrench is given in tool axes: then"),
    ],
)
def test_a_wrench_that_is_read_wrongly_is_noticed_and_how(frame, sign, expected) -> None:
    reading = WrenchReading(frame, sign, TURNED.point)
    choices = choices_of(TURNED, wrench=reading)
    doubts = import_log(log_of(TURNED, SAMPLES), choices).account.doubts
    (doubt,) = (each for each in doubts if each.kind == "convention")
    assert expected in doubt.sentence and doubt.weight is Weight.SERIOUS
    assert ("--wrench_frame tool" in doubt.remedy) == (frame == "world")
    assert ("with --invert_wrench" in doubt.remedy) == (sign == 1.0)


def test_wrong_stiffness_is_no_matter_of_signs() -> None:
    choices = replace(choices_of(TURNED), stiffness=(1000.0, 1000.0, 50.0))
    with pytest.raises(LogError, match="check --stiffness"):
        # A start 0.1 mm off its command would be pressed, if K were 10 kN/m.
        import_log(log_of(TURNED, SAMPLES), replace(choices, stiffness=(1e5, 1e5, 50.0)))
    doubts = import_log(log_of(TURNED, SAMPLES), choices).account.doubts
    (doubt,) = (each for each in doubts if each.kind == "convention")
    assert "the stiffness is not what was stated but 0.1 (± " in str(doubt)
    assert "--stiffness 100 100 50" in str(doubt) and "invert" not in str(doubt)
    assert doubt.weight is Weight.SERIOUS


def test_the_zero_of_the_sensor_is_taken_where_it_is_asked_for() -> None:
    setting = replace(TURNED, zero=(3.0, -2.0, 5.0, 0.2, -0.1, 0.3))
    log = log_of(setting, SAMPLES)
    with pytest.raises(LogError, match="at the free start, .*; subtract it with --tare"):
        import_log(log, choices_of(setting))
    content = import_log(log, choices_of(setting, tare=True)).content
    assert isinstance(content, Episode)
    # Tool axes turn by little, so a zero that is constant in them is all but constant.
    assert float((content.wrenches - EPISODE.wrenches).abs().max()) < 0.2


def test_a_recording_must_start_free() -> None:
    pressed = int(np.argmax(EPISODE.wrenches[:, 1].numpy() > 2.0))
    log = log_of(Setting(), SAMPLES).during(pressed * (HOLD + RAMP) + RAMP, None)
    with pytest.raises(LogError, match="is pressed by K"):
        import_log(log, choices_of(Setting()))


def test_holds_that_end_while_the_arm_moves_are_left_out_and_told() -> None:
    slow = sampled(EPISODE, time_constant=0.4)
    found = import_log(log_of(Setting(), slow), choices_of(Setting()))
    assert found.settled.unsettled and len(found.settled.rows) < len(EPISODE)
    assert any("holds left out, for the arm still moved" in f for f in found.account.findings)
    patient = choices_of(Setting(), stillness=Stillness(drift=(1.0, 1.0, 100.0, 10.0)))
    assert len(import_log(log_of(Setting(), slow), patient).settled.rows) == len(EPISODE)
    strict = choices_of(Setting(), stillness=Stillness(window=1.7))
    with pytest.raises(LogError, match=r"no command is held for 1.7 s|shorter than 1.7 s"):
        import_log(log_of(Setting(), slow), strict)


def test_steps_use_only_samples_that_no_finding_leaves_out() -> None:
    step = HOLD + RAMP
    # Samples that are there, such as those of a frozen sensor, at the end of the fifth hold; then
    # a time in which none came, within the window of the eighth; then one before its window.
    frozen = (5 * step - 0.2, 5 * step - 0.1)
    silent = (8 * step - 0.4, 8 * step - 0.2)
    early = (10 * step - 1.2, 10 * step - 0.9)
    log = log_of(Setting(), SAMPLES)
    findings = tuple(
        Finding("gap", Weight.LEFT_OUT, "left out", (), start, end)
        for start, end in (frozen, silent, early)
    )
    inside = (log.times > silent[0]) & (log.times < silent[1])
    log = replace(log, findings=findings).only(~inside)
    found = import_log(log, choices_of(Setting()))
    assert len(found.settled.rows) == len(EPISODE) - 2
    assert np.allclose(found.settled.broken, [5 * step - 1 / RATE, 8 * step - 1 / RATE])
    kept = np.delete(np.arange(len(EPISODE)), [4, 7])
    assert np.allclose(found.settled.rows[:, :3], EPISODE.poses.numpy()[kept], atol=1e-3)
    told = " ".join(found.account.findings)
    assert "2 stretches make no row" in told and "9.5, 15.2 s" in told
    assert "left out: left out" in told
    doubted = replace(log, findings=(Finding("unit", Weight.DOUBT, "looks odd"),))
    doubts = import_log(doubted, choices_of(Setting())).account.doubts
    assert "looks odd" in [str(doubt) for doubt in doubts]


def test_without_set_points_stretches_that_are_left_out_make_no_row() -> None:
    log = replace(log_of(Setting(), SAMPLES), command_positions=None, command_rotations=None)
    count = len(import_log(log, choices_of(Setting())).settled.rows)
    gap = Finding("gap", Weight.LEFT_OUT, "no samples", (), 10.1, 11.4)
    found = import_log(replace(log, findings=(gap,)), choices_of(Setting()))
    assert len(found.settled.rows) == count - 3 and len(found.settled.broken) == 3


def test_noise_of_rows_counts_what_is_correlated() -> None:
    # 31 stretches of 3 degrees of freedom: a standard deviation is good to 7 %; four times that.
    found = find_settled(project(log_of(Setting(), SAMPLES), Plane(), WrenchReading()), Stillness())
    assert np.allclose(found.noise / ROW_STD, 1.0, atol=0.3)
    random, correlated = np.random.default_rng(2), dict(SAMPLES)
    white = 0.2 * random.standard_normal(len(SAMPLES["time"]) + 4)
    correlated["wrench"] = SAMPLES["wrench"] + np.convolve(white, np.ones(5), "valid")[:, None]
    again = find_settled(
        project(log_of(Setting(), correlated), Plane(), WrenchReading()), Stillness()
    )
    # A sum of five: 5 times the noise of a mean, beside that of every sample.
    expected = np.hypot(ROW_STD[3:5], 5 * 0.2 / math.sqrt(WINDOW_SAMPLES))
    assert np.allclose(again.noise[3:5] / expected, 1.0, atol=0.4)


def test_readings_finer_than_they_are_printed_have_the_noise_of_rounding() -> None:
    coarse = {**SAMPLES, "pose": np.round(SAMPLES["pose"], 2)}
    found = find_settled(project(log_of(Setting(), coarse), Plane(), WrenchReading()), Stillness())
    assert found.noise[0] >= 0.01 / math.sqrt(12.0) - 1e-9


def test_noise_over_several_steps_averages_rounding_out() -> None:
    wrench = SAMPLES["wrench"].copy()
    wrench[:, :2] = 0.4 * np.round(wrench[:, :2] / 0.4)
    coarse = {**SAMPLES, "wrench": wrench}
    found = find_settled(project(log_of(Setting(), coarse), Plane(), WrenchReading()), Stillness())
    expected = math.hypot(0.2, 0.4 / math.sqrt(12.0)) / math.sqrt(WINDOW_SAMPLES)
    assert np.allclose(found.noise[3:5] / expected, 1.0, atol=0.4)


def test_motion_and_force_out_of_the_plane_are_said() -> None:
    log = log_of(Setting(), SAMPLES)
    wave = np.sin(log.times)
    log = replace(
        log,
        positions=log.positions + np.outer(0.03 * wave, [0.0, 1.0, 0.0]),
        rotations=Rotation.from_rotvec(np.outer(0.2 * np.abs(wave), [1.0, 0.0, 0.0]))
        * log.rotations,
        forces=log.forces + np.outer(5.0 * wave, [0.0, 1.0, 0.0]),
    )
    found = import_log(log, choices_of(Setting()))
    (line,) = (f for f in found.account.findings if "leaves out" in f)
    assert "60 mm of motion" in line and "11 degrees" in line and "5 N of force" in line
    assert sum("out of the plane: check" in str(doubt) for doubt in found.account.doubts) == 2


def test_without_set_points_rows_are_kept_but_are_no_episode(tmp_path: Path) -> None:
    log = replace(log_of(Setting(), SAMPLES), command_positions=None, command_rotations=None)
    found = import_log(log, choices_of(Setting()))
    assert isinstance(found.content, Measured)
    assert "no set points" in str(found.account.doubts[0])
    write_together(dict(found.files(tmp_path / "run")))
    with pytest.raises(NoCommandsError, match="commands: unknown"):
        read_episode(tmp_path / "run.csv")
    back = read_measured(tmp_path / "run.csv")
    assert np.array_equal(back.poses, found.content.poses)
    assert np.array_equal(back.wrenches, found.content.wrenches)


def test_a_ramp_is_no_hold() -> None:
    commands = np.zeros((300, 3))
    commands[100:200, 0] = np.linspace(0.0, 0.05, 100)
    commands[200:, 0] = 0.05
    long = [tuple(hold) for hold in find_holds(commands).tolist() if hold[1] - hold[0] > 10]
    assert long == [(0, 101), (199, 300)]


def test_the_angle_is_the_turn_about_the_normal() -> None:
    log = log_of(Setting(), SAMPLES)
    swing = Rotation.from_rotvec([0.3, 0.0, 0.0])
    tilted = replace(log, rotations=log.rotations * swing)
    planar = project(tilted, Plane(), WrenchReading())
    expected = SAMPLES["pose"][:, 2] - SAMPLES["pose"][0, 2]
    assert np.allclose(planar.poses[:, 2], expected, atol=1e-9)


def test_choices_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="expected right angles"):
        Plane(x=(1.0, 0.0, 0.0), z=(1.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="three positive finite numbers"):
        Importing((0.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="six numbers from 0 up"):
        Importing(STIFFNESS, sensor_std=(-1.0,) * 6)
    log = log_of(Setting(), SAMPLES)
    with pytest.raises(LogError, match="points out of the plane"):
        project(log, Plane(tool_x=(0.0, 1.0, 0.0)), WrenchReading())
    lacking = replace(log, missing=frozenset({"y", "F_y"}))
    with pytest.raises(LogError, match="y, F_y not recorded"):
        project(lacking, Plane(x=(0.0, 1.0, 0.0)), WrenchReading())
    project(lacking, Plane(), WrenchReading())
    with pytest.raises(LogError, match="of .* samples can be used"):
        log.during(1e6, None)
    assert RATE * (HOLD + RAMP) * len(EPISODE) == len(log)


def test_a_sensor_that_freezes_loses_the_rows_of_that_time_and_it_is_told() -> None:
    names = {
        "u": ("u_x", "u_z", "u_phi"),
        "pose": ("x", "z", "phi"),
        "wrench": ("F_x", "F_z", "tau"),
    }
    columns = {"time": SAMPLES["time"]}
    columns |= {
        name: SAMPLES[key][:, k].copy() for key in names for k, name in enumerate(names[key])
    }
    step = round(RATE * (HOLD + RAMP))
    columns["F_z"][6 * step + 20 : 8 * step - 10] = columns["F_z"][6 * step + 20]
    log = log_from_columns(columns, [f"{name}={name}" for name in columns], Path("frozen.csv"))
    found = import_log(log, Importing(STIFFNESS))
    whole = import_log(log_of(Setting(), SAMPLES), choices_of(Setting()))
    assert len(found.settled.rows) == len(whole.settled.rows) - 2
    (line,) = (f for f in found.account.findings if f.startswith("left out"))
    assert "F_z: frozen at" in line and "from 11.6 to 15.09 s" in line
    assert found.account.doubts == ()
