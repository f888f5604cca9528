"""The emulated controller: its surfaces by closed forms, its ports by the real client."""

from __future__ import annotations

import socket
import struct
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from robot_bench import emulator_settings, free_address

from tpcd.errors import RobotError
from tpcd.robot.emulator import EmulatorSettings, emulated_scene
from tpcd.robot.emulator.controller import MOVE_L, Controller
from tpcd.robot.emulator.process import running_emulator
from tpcd.robot.emulator.protocol import (
    DATA,
    SETUP_INPUTS,
    SETUP_OUTPUTS,
    Recipe,
    field_type,
    package,
    split_packages,
)
from tpcd.robot.emulator.surface import VERTEX_STIFFNESS, CompliantWorld, Plate
from tpcd.robot.link import Link

COMPLIANCE = 2e-4


def square_world(friction: float = 0.5) -> CompliantWorld:
    corners = np.array([[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]])
    return CompliantWorld(corners, friction, 0.0, 0.1, COMPLIANCE)


def test_a_single_vertex_yields_as_stated() -> None:
    plate = Plate(COMPLIANCE, 0.5, 1)
    _, normal = plate.press(np.zeros(1), np.array([-2e-3]))
    assert normal[0] == pytest.approx(10.0)


def test_a_flat_face_shares_the_load_of_one_plate() -> None:
    world = square_world()
    wrench = world.wrench(np.array([0.0, 0.03 - 2e-3, 0.0]))
    plate = COMPLIANCE - 1 / VERTEX_STIFFNESS
    assert wrench[1] == pytest.approx(2e-3 / (plate + 1 / (2 * VERTEX_STIFFNESS)))
    assert wrench[0] == pytest.approx(0.0) and wrench[2] == pytest.approx(0.0, abs=1e-12)


def test_a_grip_is_a_spring_until_it_slips_and_then_friction() -> None:
    world = square_world(friction=0.5)
    height = 0.03 - 2e-3
    load = world.wrench(np.array([0.0, height, 0.0]))[1]
    stuck = world.wrench(np.array([5e-4, height, 0.0]))
    spring = 1 / (COMPLIANCE - 1 / VERTEX_STIFFNESS + 1 / (2 * VERTEX_STIFFNESS))
    assert stuck[0] == pytest.approx(-5e-4 * spring)
    for x in np.linspace(5e-4, 0.02, 50):
        slid = world.wrench(np.array([x, height, 0.0]))
    assert slid[0] == pytest.approx(-0.5 * load)
    # On the way back it sticks at once, at the edge of the cone on the other side at most.
    back = world.wrench(np.array([0.02 - 2e-4, height, 0.0]))
    assert back[0] == pytest.approx(-0.5 * load + 2e-4 * spring)


def test_a_plate_stays_dragged_while_the_object_rolls_from_one_vertex_to_another() -> None:
    world = square_world(friction=2.0)
    turn, corner = 0.1, np.array([[-0.03, -0.03], [0.03, -0.03]])

    def at(angle: float, along: float) -> np.ndarray:
        """The square on its lower corner, which has moved by `along` from where it would be if
        it had rolled to this angle."""
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        lowest = (corner @ rotation.T)[0 if angle > 0 else 1]
        foot = corner[0 if angle > 0 else 1, 0] + along
        return world.wrench(np.array([foot - lowest[0], -lowest[1] - 1e-3, angle]))

    at(turn, 0.0)
    for share in np.linspace(0.0, 1.0, 21):
        dragged = at(turn, 4e-4 * share)
    assert dragged[0] == pytest.approx(-4e-4 / COMPLIANCE)
    # Over the flat face, where both corners hold, and on: the plate is where it was.
    for angle in np.linspace(turn, -turn, 2001):
        rolled = at(angle, 4e-4)
    assert rolled[0] == pytest.approx(dragged[0], rel=0.03)


def test_the_wall_pushes_left_and_its_torque_is_force_times_lever() -> None:
    wrench = square_world(0.0).wrench(np.array([0.1 - 0.03 + 1e-3, 0.2, 0.0]))
    assert wrench[0] < -4.0 and wrench[1] == 0.0 and wrench[2] == pytest.approx(0.0, abs=1e-12)
    tilted = square_world(0.0).wrench(np.array([0.0, 0.032, 0.2]))
    lever = np.cos(0.2) * -0.03 + np.sin(0.2) * 0.03
    assert tilted[2] == pytest.approx(lever * tilted[1])


def test_out_of_contact_nothing_acts_and_nothing_is_remembered() -> None:
    world = square_world()
    world.wrench(np.array([0.0, 0.028, 0.0]))
    world.wrench(np.array([0.01, 0.028, 0.0]))
    assert not world.wrench(np.array([0.01, 0.05, 0.0])).any()
    assert world.wrench(np.array([0.03, 0.028, 0.0]))[0] == pytest.approx(0.0)


@given(st.lists(st.binary(max_size=40), max_size=5), st.integers(1, 7))
def test_packages_come_out_whole_however_they_arrive(payloads: list[bytes], size: int) -> None:
    stream = b"".join(package(DATA, payload) for payload in payloads)
    found, rest = [], b""
    for start in range(0, len(stream), size):
        packages, rest = split_packages(rest + stream[start : start + size])
        found += packages
    assert found == [(DATA, payload) for payload in payloads] and rest == b""


def test_a_recipe_packs_big_endian_in_its_order() -> None:
    names = ("timestamp", "output_int_register_0", "actual_TCP_pose")
    recipe = Recipe(1, names, tuple(field_type(name) for name in names))
    data = recipe.encode({"timestamp": 2.0, "output_int_register_0": 1})
    assert data[:4] == struct.pack(">HBB", 3 + 1 + 8 + 4 + 48, DATA, 1)
    assert struct.unpack(">di6d", data[4:]) == (2.0, 1, *[0.0] * 6)
    assert field_type("nothing_like_it") == "NOT_FOUND"


@pytest.fixture(scope="module")
def emulator() -> EmulatorSettings:
    return emulator_settings(pace="real", pose_noise=0.0, force_noise=0.0)


@pytest.fixture(scope="module")
def clients(emulator: EmulatorSettings):
    control = pytest.importorskip("rtde_control")
    receive = pytest.importorskip("rtde_receive")
    with running_emulator(emulator):
        reader = receive.RTDEReceiveInterface(
            emulator.address, 500.0, ["timestamp", "actual_TCP_pose", "actual_TCP_force"]
        )
        writer = control.RTDEControlInterface(emulator.address)
        yield writer, reader
        writer.disconnect()
        reader.disconnect()


def test_the_real_client_moves_it_and_zeroes_its_sensor(clients) -> None:
    control, receive = clients
    start = receive.getActualTCPPose()
    goal = [*start[:2], start[2] + 0.01, *start[3:]]
    assert control.isProgramRunning() and control.moveL(goal, 0.05, 0.5)
    time.sleep(0.02)
    assert receive.getActualTCPPose()[2] == pytest.approx(goal[2], abs=1e-6)
    assert control.zeroFtSensor() and control.moveL(start, 0.05, 0.5)


def test_the_arm_is_at_a_target_one_delay_later(clients, emulator: EmulatorSettings) -> None:
    """Never earlier, and not later either where the machine has time for it."""
    control, receive = clients
    delays = []
    for _ in range(8):
        start = receive.getActualTCPPose()
        goal = [*start[:2], start[2] + 1e-3, *start[3:]]
        sent = receive.getTimestamp()
        assert control.servoL(goal, 0.0, 0.0, 0.002, 0.03, 500.0)
        deadline = time.monotonic() + 2.0
        while receive.getActualTCPPose()[2] < start[2] + 5e-4:
            assert time.monotonic() < deadline
            time.sleep(2e-4)
        delays.append(receive.getTimestamp() - sent)
        time.sleep(2 * emulator.servo_delay)  # until all of the way is done
    assert min(delays) >= emulator.servo_delay - 0.004
    assert min(delays) <= emulator.servo_delay + 0.05
    assert control.servoStop()


def test_stamps_grow_at_the_controller_s_rate(clients) -> None:
    _, receive = clients
    first, began, seen = receive.getTimestamp(), time.monotonic(), set()
    while time.monotonic() - began < 1.0:
        seen.add(receive.getTimestamp())
        time.sleep(5e-4)
    passed = receive.getTimestamp() - first
    assert passed == pytest.approx(time.monotonic() - began, abs=0.2)
    # 497 a second on an idle machine.
    assert len(seen) > 200


def test_a_script_can_be_stopped_and_uploaded_again(clients) -> None:
    control, _ = clients
    control.stopScript()
    assert not control.isProgramRunning()
    assert control.reuploadScript()
    deadline = time.monotonic() + 2.0
    while not control.isProgramRunning():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert control.zeroFtSensor()


def test_a_second_client_is_refused_and_the_first_goes_on(
    clients, emulator: EmulatorSettings
) -> None:
    control, _ = clients
    with pytest.raises(RobotError, match="registers are in use by another client"):
        Link(emulator.address, 125.0)
    assert control.isProgramRunning() and control.zeroFtSensor()


@pytest.mark.parametrize(
    ("port", "sent"),
    [
        (30004, package(SETUP_OUTPUTS, b"")),
        (30004, package(SETUP_OUTPUTS, struct.pack(">d", 0.0) + b"timestamp")),
        (30004, package(SETUP_INPUTS, b"\xff")),
        (30004, package(SETUP_INPUTS, b"input_bit_register_64") + package(DATA, b"\1abc")),
        (30004, package(DATA, b"")),
    ],
)
def test_what_is_no_message_ends_its_connection_alone(
    port: int, sent: bytes, clients, emulator: EmulatorSettings
) -> None:
    with socket.create_connection((emulator.address, port), timeout=10.0) as connection:
        connection.sendall(sent)
        while connection.recv(4096):
            pass
    assert clients[0].isProgramRunning()


def test_a_target_that_is_no_number_is_a_protective_stop() -> None:
    controller = Controller(emulator_settings())
    controller.upload()
    place = {f"input_double_register_{index}": float("nan") for index in range(6)}
    controller.write({**place, "input_int_register_0": MOVE_L})
    controller.advance()
    assert controller.protective_stopped


def test_a_target_out_of_the_plane_ends_in_a_protective_stop(clients) -> None:
    control, receive = clients
    start = receive.getActualTCPPose()
    assert control.servoL([start[0], start[1] + 0.02, *start[2:]], 0.0, 0.0, 0.002, 0.03, 500.0)
    time.sleep(0.05)
    assert not control.isProgramRunning()
    assert not control.servoL(start, 0.0, 0.0, 0.002, 0.03, 500.0)


@pytest.mark.parametrize(
    ("fault", "said"),
    [("register_in_use", "registers are in use"), ("local_control", "remote control")],
)
def test_a_controller_that_cannot_be_used_is_told_apart(fault: str, said: str) -> None:
    pytest.importorskip("rtde_control")
    settings = emulator_settings(fault=fault)
    with running_emulator(settings), pytest.raises(RobotError, match=said):
        Link(settings.address, 125.0)


def test_nobody_at_an_address_is_one_line() -> None:
    pytest.importorskip("rtde_control")
    with pytest.raises(RobotError, match="cannot connect") as caught:
        Link(free_address(), 125.0)
    assert "\n" not in str(caught.value)


def test_an_address_that_is_taken_is_refused(emulator: EmulatorSettings, clients) -> None:
    with (
        pytest.raises(RobotError, match="cannot listen"),
        running_emulator(emulator),
    ):
        pass


def test_equal_seeds_are_equal_scenes() -> None:
    first, again = (emulated_scene(EmulatorSettings(outline="mug", seed=4)) for _ in range(2))
    assert first.theta == again.theta
    assert emulated_scene(EmulatorSettings(outline="mug", seed=5)).theta != first.theta


@pytest.mark.parametrize("wrong", [{"surface_mm_per_10n": -1.0}, {"friction": (0.9, 0.1)}])
def test_worlds_that_cannot_be_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        EmulatorSettings(**wrong)
