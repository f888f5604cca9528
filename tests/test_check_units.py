"""Numbers in another unit than they are read in, and poses that no arm has, are told as such."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_logs import Setting
from made_streams import alarms, changed, made_stream

from tpcd.quality.finding import Weight
from tpcd.quality.noise import noise_at_rest
from tpcd.quality.rotation import check_poses
from tpcd.quality.stream import Stream
from tpcd.quality.units import check_units


def scaled(stream: Stream, names: tuple[str, ...], factor: float) -> Stream:
    values = stream.values.copy()
    values[:, [stream.channels.index(name) for name in names]] *= factor
    return replace(stream, values=values)


def planar(factor: float = 1.0) -> Stream:
    times = np.arange(2000) / 100.0
    angle = factor * (0.6 * np.sin(times) + 0.001 * np.random.default_rng(0).normal(size=2000))
    return Stream("made", ("x", "z", "phi"), times, np.column_stack((0.1 * angle, angle, angle)))


@pytest.mark.parametrize(
    ("names", "factor", "likely", "entry"),
    [
        (("x", "y", "z"), 1e3, "millimetres", "=COLUMN:mm"),
        (("u_x", "u_y", "u_z"), 1e3, "millimetres", "=COLUMN:mm"),
        (("F_x", "F_y", "F_z"), 1e3, "millinewtons", "=COLUMN:mN"),
        (("T_x", "T_y", "T_z"), 1e3, "newton millimetres", "=COLUMN:Nmm"),
    ],
)
def test_another_unit_is_named(
    names: tuple[str, ...], factor: float, likely: str, entry: str
) -> None:
    stream = made_stream()
    assert check_units([stream]) == ()
    told = [f for f in check_units([scaled(stream, names, factor)]) if f.channels == names]
    assert len(told) == 1 and likely in told[0].sentence and entry in told[0].remedy
    assert told[0].weight in (Weight.SERIOUS, Weight.DOUBT)


def test_positions_of_500_m_are_plainly_millimetres() -> None:
    stream = made_stream()
    values = stream.values.copy()
    values[:, :3] = 1e3 * values[:, :3] + 500.0
    told = [f for f in check_units([replace(stream, values=values)]) if f.channels[0] == "x"]
    assert told[0].weight is Weight.SERIOUS and "looks like millimetres" in told[0].sentence
    assert "=COLUMN:mm" in told[0].remedy


def test_angles_in_degrees_and_times_in_milliseconds_are_named() -> None:
    assert check_units([planar()]) == ()
    (told,) = (f for f in check_units([planar(180 / np.pi)]) if f.channels == ("phi",))
    assert "degrees" in told.sentence and "phi=COLUMN:deg" in told.remedy
    stream = made_stream()
    (told,) = check_units([replace(stream, times=1e3 * stream.times)])
    assert told.channels == ("time",) and "milliseconds" in told.sentence


def test_turns_that_are_counted_on_are_not_plainly_degrees() -> None:
    times = np.arange(6000) / 100.0
    turned = Stream("made", ("phi",), times, 0.8 * times[:, None])
    (told,) = check_units([turned])
    assert told.weight is Weight.DOUBT and "or turns that are counted on" in told.sentence
    (told,) = check_units([replace(turned, values=180 / np.pi * turned.values)])
    assert told.weight is Weight.SERIOUS and told.sentence.endswith("looks like degrees")


def test_metres_taken_for_millimetres_are_doubted() -> None:
    stream = scaled(made_stream(), ("x", "y", "z"), 1e-3)
    told = check_units([stream])
    assert any("taken for" in f.sentence or "another unit" in f.sentence for f in told)


def test_quaternions_that_change_sign_are_noted_and_those_of_no_length_left_out() -> None:
    stream = made_stream()
    values = stream.values.copy()
    values[1000:2000, 3:7] *= -1.0
    (told,) = check_poses([replace(stream, values=values)])
    assert told.kind == "flip" and told.weight is Weight.NOTE and "2 times" in told.sentence
    values = stream.values.copy()
    values[300:310, 3:7] = 0.0
    (told,) = alarms(check_poses([replace(stream, values=values)]))
    assert told.kind == "no_rotation" and told.rows == (300, 310)
    (told,) = alarms(check_poses([scaled(stream, ("qx", "qy", "qz", "qw"), 1.1)]))
    assert told.kind == "not_unit" and told.weight is Weight.SERIOUS


def test_a_pose_that_jumps_is_named_and_one_that_was_lost_for_a_while_is_not() -> None:
    stream = made_stream()
    assert check_poses([stream]) == ()
    place = stream.channels.index("x")
    (told,) = check_poses([changed(stream, "x", 3000, 5510, stream.values[3000:, place] + 0.3)])
    assert told.kind == "jump" and told.rows == (2999, 3001) and told.weight is Weight.DOUBT
    without = np.delete(np.arange(5510), slice(1500, 1900))
    gap = replace(stream, times=stream.times[without], values=stream.values[without])
    assert check_poses([gap]) == ()


def test_noise_at_rest_is_that_of_the_sensor() -> None:
    for noise, steps in ((1.0, 0.0), (3.0, 0.1), (1.0, 1.0)):
        stream = made_stream(noise, steps, setting=Setting())
        told = {each.name: each for each in noise_at_rest([stream])}
        assert told["F_x"].moments >= 5
        for name, std in (("x", 1e-4), ("rotation", 3e-4), ("F_x", 0.2), ("T_y", 0.01)):
            assert told[name].sample == pytest.approx(noise * std, rel=0.4), name
        # Rows of 50 samples of white noise, or what the steps hide.
        row = max(noise * 0.2 / np.sqrt(50), steps * 0.2 / np.sqrt(12))
        assert told["F_z"].row == pytest.approx(row, rel=0.4)
        assert all(each.creep == 0.0 for each in told.values())


def test_creep_at_rest_is_measured() -> None:
    random = np.random.default_rng(1)
    times = np.arange(4000) / 100.0
    pose = 1e-6 * random.normal(size=(4000, 3))
    force = 0.02 * random.normal(size=(4000, 3)) + np.outer(times, [0.0, 0.0, 0.01])
    stream = Stream("made", ("x", "y", "z", "F_x", "F_y", "F_z"), times, np.hstack((pose, force)))
    told = {each.name: each for each in noise_at_rest([stream])}
    assert told["F_z"].creep == pytest.approx(0.4, rel=0.1)
    assert told["F_z"].creep_time == pytest.approx(40.0, rel=0.05)
    assert told["F_x"].creep == 0.0


def test_an_arm_that_jumps_with_its_set_point_follows_it() -> None:
    stream = made_stream()
    moved = stream.values.copy()
    moved[3000:, stream.channels.index("x")] += 0.3
    commanded = moved.copy()
    commanded[3000:, stream.channels.index("u_x")] += 0.3
    assert [f.kind for f in check_poses([replace(stream, values=moved)])] == ["jump"]
    assert check_poses([replace(stream, values=commanded)]) == ()
