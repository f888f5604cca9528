"""Conventions mistaken one at a time and in pairs: each is named, with the option that mends it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_logs import HOLD, RAMP, RATE, STIFFNESS, Setting, an_episode, choices_of, log_of, sampled
from made_mistakes import (
    ALONG,
    DOWN,
    MISTAKES,
    PAIRS,
    TURNED,
    convention_doubts,
    w_first,
    wrong_order,
)
from scipy.spatial.transform import Rotation

from tpcd.data.episode import Episode
from tpcd.logs.columns import log_from_columns
from tpcd.logs.conventions import RotationReading
from tpcd.logs.importing import Importing, import_log
from tpcd.logs.log import Log, LogError, RotationNumbers
from tpcd.logs.plane import Plane, WrenchReading
from tpcd.quality.finding import Finding, Weight

EPISODE = an_episode(20)
SAMPLES = sampled(EPISODE)
DEGREES = 180 / np.pi


@pytest.mark.parametrize("setting", [ALONG, DOWN, TURNED], ids=["along", "down", "turned"])
@pytest.mark.parametrize("name", MISTAKES)
def test_each_mistake_is_named_with_what_mends_it(name: str, setting: Setting) -> None:
    mistake, remedy = MISTAKES[name]
    log, choices = mistake(log_of(setting, SAMPLES), choices_of(setting))
    doubts = convention_doubts(log, choices)
    if setting is DOWN and name == "sense":
        # A hand that points down has rotations that are their own inverse: the same episode.
        assert doubts == []
        assert np.allclose(_rows(log, choices), _rows(log_of(DOWN, SAMPLES), choices), atol=1e-6)
        return
    (doubt,) = doubts
    assert doubt.weight is (Weight.DOUBT if (setting, name) == (ALONG, "frame") else Weight.SERIOUS)
    assert remedy in str(doubt).split(", or with")[0], str(doubt)


def _rows(log: Log, choices: Importing) -> np.ndarray:
    content = import_log(log, choices).content
    assert isinstance(content, Episode)
    return np.column_stack((content.commands, content.poses, content.wrenches))


@pytest.mark.parametrize("setting", [ALONG, TURNED], ids=["along", "turned"])
def test_a_wrong_order_is_never_told_as_an_inverted_torque(setting: Setting) -> None:
    log, choices = wrong_order(log_of(setting, SAMPLES), choices_of(setting))
    (doubt,) = convention_doubts(log, choices)
    assert "the quaternions are w, x, y, z" in doubt.sentence
    assert "inverted" not in doubt.sentence and "--invert_torque" not in doubt.remedy
    mended = replace(choices, rotation=RotationReading("wxyz"))
    found = import_log(log, mended)
    assert found.account.doubts == ()
    right = _rows(log_of(setting, SAMPLES), choices_of(setting))
    assert np.allclose(_rows(log, mended), right, atol=1e-9)


def test_who_inverts_the_torque_where_the_order_is_wrong_is_told_that_the_episode_is_mirrored():
    log, choices = wrong_order(log_of(ALONG, SAMPLES), choices_of(ALONG))
    mirrored = replace(choices, wrench=replace(choices.wrench, torque_sign=-1.0))
    doubts = import_log(log, mirrored).account.doubts
    assert [each.kind for each in doubts] == ["mirrored"]
    assert "from within the object" in str(doubts[0]) and "--invert_rotation" in str(doubts[0])


def test_pairs_of_mistakes_are_told_apart() -> None:
    """20 of 21 pairs at least, with both remedies."""
    right, missed = 0, []
    for pair in PAIRS:
        log, choices = log_of(TURNED, SAMPLES), choices_of(TURNED)
        # Numbers are put in another order last, so that is undone first.
        for name in reversed(pair):
            log, choices = MISTAKES[name][0](log, choices)
        doubts = convention_doubts(log, choices)
        told = str(doubts[0]) if doubts else ""
        named = all(MISTAKES[name][1] in told for name in pair)
        right += named
        missed += [] if named else [(pair, told)]
    assert len(PAIRS) == 21
    assert right >= 20, "\n".join(map(str, missed))


@pytest.mark.parametrize(("seed", "mistakes"), [(0, ()), (3, MISTAKES)], ids=["none", "each"])
def test_arms_and_sensors_as_they_are_raise_no_doubt_and_hide_no_mistake(seed, mistakes) -> None:
    """A gain of 5 %, a sensor turned by 3 degrees, and 0.3 N that change from step to step: no
    false alarm, and each mistake is named (72 of 72 in 8 such recordings)."""
    made, random = an_episode(14, seed), np.random.default_rng(seed)
    wrenches = made.wrenches.clone()
    turn = Rotation.from_euler("z", 3, degrees=True).as_matrix()[:2, :2]
    wrenches[:, :2] = 1.05 * wrenches[:, :2] @ torch.from_numpy(turn.T)
    wrenches[1:] += torch.from_numpy(random.normal(0, (0.3, 0.3, 0.02), (len(made) - 1, 3)))
    samples = sampled(replace(made, wrenches=wrenches), seed)
    assert convention_doubts(log_of(TURNED, samples), choices_of(TURNED)) == []
    for name in mistakes:
        mistake, remedy = MISTAKES[name]
        doubts = convention_doubts(*mistake(log_of(TURNED, samples), choices_of(TURNED)))
        assert remedy in " ".join(map(str, doubts))


def stated(choices: Importing, factors: tuple[float, float, float]) -> Importing:
    x, z, phi = (s * f for s, f in zip(STIFFNESS, factors, strict=True))
    return replace(choices, stiffness=(x, z, phi))


@pytest.mark.parametrize(
    "factors", [(1.3, 1.3, 1.3), (0.7, 0.7, 0.7), (1.0, 0.7, 1.0), (0.7, 1.3, 2.0), (0.1, 0.1, 0.1)]
)
def test_a_stiffness_stated_wrongly_is_named_with_the_right_one(factors) -> None:
    (doubt,) = convention_doubts(log_of(TURNED, SAMPLES), stated(choices_of(TURNED), factors))
    assert "the stiffness is not what was stated" in doubt.sentence and "axes" not in str(doubt)
    given = [float(word) for word in doubt.remedy.split()[1:4]]
    assert given == pytest.approx(STIFFNESS, rel=0.01)


@pytest.mark.parametrize("name", ["sense", "sign", "frame", "channels", "point", "length"])
def test_a_wrong_stiffness_is_named_beside_another_mistake(name: str) -> None:
    mistake, remedy = MISTAKES[name]
    log, choices = mistake(log_of(TURNED, SAMPLES), choices_of(TURNED))
    told = str(convention_doubts(log, stated(choices, (0.7, 1.3, 2.0)))[0])
    assert remedy in told and "the stiffness is not what was stated" in told


def pressed(friction: float = 0.0, drift: float = 0.0, most: float = np.inf) -> list[Finding]:
    """What is doubted of an arm that stops short by friction [N], and of a sensor that drifts by
    so much from the first row to the last, or ends there [N]."""
    moved = np.sign(np.diff(EPISODE.commands.numpy(), axis=0, prepend=EPISODE.commands[:1]))
    poses = EPISODE.poses.numpy() - friction * moved * [1.0, 1.0, 0.1] / np.array(STIFFNESS)
    wrenches = EPISODE.wrenches.numpy().clip(-most, most)
    wrenches = wrenches + drift * np.linspace(0.0, 1.0, len(poses))[:, None] * [1.0, 1.0, 0.0]
    made = replace(EPISODE, poses=torch.from_numpy(poses), wrenches=torch.from_numpy(wrenches))
    account = import_log(log_of(TURNED, sampled(made)), choices_of(TURNED)).account
    if friction != 0.1:  # so much is within what sensors are off by
        assert ("friction of the arm holds" in " ".join(account.findings)) == (friction > 0)
    return [each for each in account.doubts if each.kind in ("parity", "convention")]


@pytest.mark.parametrize("friction", [0.0, 0.2, 0.5])
def test_friction_of_an_arm_is_told_and_not_doubted(friction: float) -> None:
    assert pressed(friction) == []


def test_a_wrench_that_drifts_or_saturates_is_told_so() -> None:
    (drifting,) = pressed(0.1, drift=0.6)
    assert drifting.kind == "parity" and "it drifts by F_x 0." in drifting.sentence
    assert "times it" not in drifting.sentence
    (bent,) = pressed(0.1, most=4.0)
    assert "it bends by F_x -1." in bent.sentence and "saturates" in bent.sentence


def planar_log(**signs: float) -> Log:
    """A planar recording, some of whose columns have another sign or unit."""
    columns = {"time": SAMPLES["time"]}
    for names, key in (("u_x u_z u_phi", "u"), ("x z phi", "pose"), ("F_x F_z tau", "wrench")):
        for k, name in enumerate(names.split()):
            columns[name] = signs.get(name, 1.0) * SAMPLES[key][:, k]
    entries = [f"{name}={name}" for name in columns]
    return log_from_columns(columns, entries, Path("planar.csv"))


def test_an_angle_that_turns_the_other_way_is_told_from_a_torque_that_does() -> None:
    assert import_log(planar_log(), Importing(STIFFNESS)).account.doubts == ()
    (angle,) = import_log(planar_log(phi=-1, u_phi=-1), Importing(STIFFNESS)).account.doubts
    assert "phi turns from z to x" in str(angle) and angle.remedy == "with --invert_rotation"
    (torque,) = import_log(planar_log(tau=-1), Importing(STIFFNESS)).account.doubts
    assert "the torques alone turn the other way" in str(torque)
    assert torque.remedy.startswith("with --invert_torque, or with --invert_rotation; to tell")
    (both,) = import_log(planar_log(tau=-1, phi=-1, u_phi=-1), Importing(STIFFNESS)).account.doubts
    assert both.kind == "mirrored"
    mended = Importing(
        STIFFNESS,
        rotation=RotationReading(inverse=True),
        wrench=WrenchReading(torque_sign=-1.0),
    )
    assert import_log(planar_log(tau=-1, phi=-1, u_phi=-1), mended).account.doubts == ()


@pytest.mark.parametrize(
    ("signs", "told", "remedy"),
    [
        ({"phi": DEGREES, "u_phi": DEGREES}, "angles are in degrees", "--map phi=phi:deg u_phi="),
        ({"tau": 1e3}, "torques are in N·mm", "--map tau=tau:Nmm"),
        (
            {"F_x": -1.0},
            "so that -F_x, F_z are what is called F_x, F_z",
            "change the sign of the column",
        ),
        (
            {name: 1e3 for name in ("x", "z", "u_x", "u_z")},
            "positions look like millimetres",
            "--map x=x:mm z=z:mm u_x=u_x:mm u_z=u_z:mm",
        ),
    ],
)
def test_units_and_single_axes_are_named_with_the_map_that_mends_them(signs, told, remedy) -> None:
    doubts = convention_doubts(planar_log(**signs), Importing(STIFFNESS))
    assert len(doubts) == 1 and told in doubts[0].sentence and remedy in doubts[0].remedy


def test_a_stiffness_in_newton_per_millimetre_is_named() -> None:
    with pytest.raises(ValueError, match="stiffness is 0.1, expected N/m .*looks like N/mm"):
        Importing((0.1, 0.1, 50.0))
    # A stiff arm's 20 N/mm could be 20 N/m, were it not for its forces.
    stiff = np.array([2e4, 2e4, 50.0])
    samples = {key: values.copy() for key, values in SAMPLES.items()}
    samples["u"] = samples["pose"] - samples["wrench"] / stiff
    step = round((HOLD + RAMP) * RATE)
    for k in range(0, len(samples["u"]), step):
        samples["u"][k : k + step] = samples["u"][k + step // 2 : k + step].mean(0)
    log = log_of(ALONG, samples)
    (doubt,) = convention_doubts(log, replace(choices_of(ALONG), stiffness=(20.0, 20.0, 50.0)))
    assert "the stiffness is in N/mm" in doubt.sentence and "1000 times as much" in doubt.remedy


@pytest.mark.parametrize("axes", ["XYZ", "zyx", "ZYZ"])
def test_axes_of_euler_angles_are_named(axes: str) -> None:
    log = log_of(TURNED, SAMPLES)
    assert log.command_rotations is not None

    def as_zyx(rotations: Rotation) -> RotationNumbers:
        return RotationNumbers("Euler angles", rotations.as_euler(axes), "ZYX")

    numbers, targets = as_zyx(log.rotations), as_zyx(log.command_rotations)
    log = replace(
        log,
        numbers=numbers,
        command_numbers=targets,
        rotations=numbers.rotations(),
        command_rotations=targets.rotations(),
    )
    choices = choices_of(TURNED)
    choices = replace(choices, plane=replace(choices.plane, tool_x=None))
    (doubt,) = convention_doubts(log, choices)
    assert f"--euler {axes}" in doubt.remedy


@pytest.mark.parametrize("which", ["both", "pose"])
def test_angles_that_count_their_turns_are_the_same_episode(which: str) -> None:
    turns = 8.0 * np.pi * np.linspace(0.0, 1.0, len(EPISODE))
    values = [EPISODE.poses.clone(), EPISODE.commands.clone()]
    for each in values:
        each[:, 2] += torch.from_numpy(turns)
    samples = sampled(replace(EPISODE, poses=values[0], commands=values[1], unusual=True))
    columns = {"time": samples["time"]}
    for names, key in (("u_x u_z u_phi", "u"), ("x z phi", "pose"), ("F_x F_z tau", "wrench")):
        columns |= {name: samples[key][:, k] for k, name in enumerate(names.split())}
    if which == "pose":
        columns["u_phi"] = np.angle(np.exp(1j * columns["u_phi"]))
    log = log_from_columns(columns, [f"{name}={name}" for name in columns], Path("planar.csv"))
    assert columns["phi"].max() > 25.0
    found = import_log(log, Importing(STIFFNESS))
    assert found.account.doubts == () and isinstance(found.content, Episode)
    assert float(found.content.poses[:, 2].abs().max()) <= np.pi


def test_a_hand_that_turns_over_out_of_the_plane_is_told_so() -> None:
    log = log_of(ALONG, SAMPLES)
    assert log.command_rotations is not None
    over = Rotation.from_rotvec(np.outer(np.linspace(0.0, np.pi, len(log)), [1.0, 0.0, 0.0]))
    log = replace(
        log, rotations=over * log.rotations, command_rotations=over * log.command_rotations
    )
    with pytest.raises(LogError, match="turned out of the plane by 1[78]. degrees .*--plane_x"):
        import_log(log, replace(choices_of(ALONG), plane=Plane()))


def test_what_free_motion_and_small_turns_cannot_show_is_said() -> None:
    free = replace(EPISODE, poses=EPISODE.commands, wrenches=0 * EPISODE.wrenches)
    found = import_log(log_of(ALONG, sampled(free)), choices_of(ALONG))
    assert [each.kind for each in found.account.doubts][0] == "contact"
    assert any("nothing in the recording shows whether" in f for f in found.account.findings)
    flat = {key: values.copy() for key, values in SAMPLES.items()}
    flat["pose"][:, 2] *= 1e-2
    flat["u"][:, 2] *= 1e-2
    flat["wrench"][:, 2] *= 1e-2
    log, choices = wrong_order(log_of(ALONG, flat), choices_of(ALONG))
    found = import_log(log, choices)
    (line,) = (f for f in found.account.findings if "neither the order nor the sense" in f)
    assert "the arm turns by 0.0" in line and "turn it by 10 degrees" in line


def test_a_sensor_that_was_zeroed_in_contact_is_doubted() -> None:
    start = EPISODE.wrenches.clone()
    pressed = torch.tensor([0.0, 0.8, 0.0], dtype=torch.float64)
    wrenches = start - pressed
    wrenches[0] = 0.0
    commands = EPISODE.commands.clone()
    commands[0] -= pressed / EPISODE.stiffness
    touching = replace(EPISODE, wrenches=wrenches, commands=commands)
    doubts = import_log(log_of(ALONG, sampled(touching)), choices_of(ALONG)).account.doubts
    (zero,) = (each for each in doubts if each.kind == "zero")
    assert zero.weight is Weight.SERIOUS and "K (x - u) = (0.0" in zero.sentence
    assert "--tare" in zero.remedy
    lagging = replace(EPISODE, commands=commands)
    doubts = import_log(log_of(ALONG, sampled(lagging)), choices_of(ALONG)).account.doubts
    assert not [each for each in doubts if each.kind == "zero"]


def test_quaternions_in_the_wrong_order_turn_backwards_about_another_axis() -> None:
    turns = Rotation.from_quat(np.random.default_rng(1).normal(size=(20, 4)))
    wrong = w_first(turns)
    angles = (turns[:-1].inv() * turns[1:]).magnitude()
    assert np.allclose((wrong[:-1].inv() * wrong[1:]).magnitude(), angles)
    # q' = a q* b: what follows in the body goes before in the world, backwards.
    axes = (turns[:-1].inv() * turns[1:]).as_rotvec()
    moved = (wrong[1:] * wrong[:-1].inv()).as_rotvec()
    found, error = Rotation.align_vectors(moved, -axes)[:2]
    assert error < 1e-6 and found.magnitude() > 0.1


def test_a_set_point_without_its_rotation_is_named_where_the_torque_tells() -> None:
    columns = {"time": SAMPLES["time"]}
    for key, names in (("u", "u_x u_z"), ("pose", "x z phi"), ("wrench", "F_x F_z tau")):
        columns |= {name: SAMPLES[key][:, k] for k, name in enumerate(names.split())}
    log = log_from_columns(columns, [f"{name}={name}" for name in columns], Path("planar.csv"))
    (doubt,) = convention_doubts(log, Importing(STIFFNESS))
    assert "the rotation of the set point is not in the map" in doubt.sentence
    assert doubt.weight is Weight.SERIOUS and "u_phi" in doubt.remedy
