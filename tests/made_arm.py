"""Recordings of an arm under impedance control in three dimensions, all of which is known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tpcd.identification.quantity import Quantity
from tpcd.logs.log import Log


@dataclass(frozen=True)
class Arm:
    """What a recording is made with."""

    stiffness: tuple[float, ...] = (600.0, 500.0, 800.0, 30.0, 40.0, 25.0)
    friction: tuple[float, ...] = (0.5, 0.4, 0.6, 0.05, 0.04, 0.06)
    pose_lag: float = 0.06
    weight: float = -6.0
    centre: tuple[float, float, float] = (0.01, -0.005, 0.06)
    force_bias: tuple[float, float, float] = (1.0, -2.0, 3.0)
    torque_bias: tuple[float, float, float] = (0.1, -0.05, 0.02)
    sensor_rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """About which torques are given, from the end effector's origin."""
    gain: float = 1.0
    frame: str = "tool"
    sign: float = 1.0
    pose_std: float = 3e-5
    angle_std: float = 1e-4
    force_std: float = 0.2
    torque_std: float = 0.01
    slow: float = 1.0
    """Standard deviation of slow noise over that of the white."""
    load: float = 15.0
    """Typical contact force [N]."""
    turn: float = 0.5
    """Typical rotation [rad]."""


def holds(told: Quantity, value: float) -> bool:
    """Whether an interval that is told holds a value."""
    assert told.interval is not None, told
    return told.interval[0] <= value <= told.interval[1]


def half_width(told: Quantity) -> float:
    """Half an interval that is told."""
    assert told.interval is not None, told
    return (told.interval[1] - told.interval[0]) / 2


def truth(arm: Arm) -> dict[str, float]:
    """What identification should find, by the names of its quantities; the centre of mass, point
    and rotation in the sensor's axes, stiffness and friction times the gain."""
    turn = Rotation.from_rotvec(arm.sensor_rotation)
    vectors = {
        "force_bias": arm.sign * np.array(arm.force_bias),
        "torque_bias": arm.sign * np.array(arm.torque_bias),
        "centre_of_mass": turn.apply(arm.centre),
        "sensor_rotation": np.array(arm.sensor_rotation),
        "sensor_point": turn.apply(arm.point),
    }
    found = {f"{kind}_{a}": float(v[k]) for kind, v in vectors.items() for k, a in enumerate("xyz")}
    for k, axis in enumerate(("x", "y", "z", "rx", "ry", "rz")):
        found[f"stiffness_{axis}"] = arm.gain * arm.stiffness[k]
        found[f"arm_friction_{axis}"] = arm.gain * arm.friction[k]
    weight = arm.sign * arm.gain * arm.weight
    return {**found, "weight": weight, "pose_lag": arm.pose_lag, "wrench_lag": 0.0}


def smooth(random, times, scale, columns):
    """Random functions of time with unit variance, that change over `scale` seconds."""
    step = times[1] - times[0]
    width = max(1, round(scale / step))
    kernel = np.hanning(4 * width + 1)
    kernel /= np.sqrt((kernel**2).sum())
    raw = random.standard_normal((len(times) + len(kernel) - 1, columns))
    return np.stack([np.convolve(raw[:, k], kernel, mode="valid") for k in range(columns)], axis=1)


def play(targets, half):
    """What follows `targets` but is held by friction within `half` of them."""
    found = np.empty_like(targets)
    last = targets[0]
    for k, target in enumerate(targets):
        last = np.clip(last, target - half, target + half)
        found[k] = last
    return found


def turned_play(targets, half):
    """The same of rotations, about the world's axes."""
    found = np.empty((len(targets), 3, 3))
    matrices = targets.as_matrix()
    last = matrices[0]
    for k, target in enumerate(matrices):
        off = last @ target.T
        # Friction holds less than a tenth of a radian.
        away = 0.5 * np.array([off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]])
        x, y, z = np.clip(away, -half, half)
        turn = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        last = target + turn @ target + 0.5 * turn @ turn @ target
        found[k] = last
    return Rotation.from_matrix(found)


def moving(arm: Arm, seed: int, seconds: float = 200.0, rate: float = 50.0) -> Log:
    """An arm that moves, turns, and is pressed about half of the time, without saying when."""
    random = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, 1.0 / rate)
    early = times - arm.pose_lag
    path, turns = smooth(random, times, 1.5, 3) * 0.05, smooth(random, times, 2.5, 3) * arm.turn
    base = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    commands, targets = path, Rotation.from_rotvec(turns) * base

    def late(values):
        return np.stack([np.interp(early, times, column) for column in values.T], axis=1)

    touching = smooth(random, times, 3.0, 1) > 0
    wrench = smooth(random, times, 1.0, 6) * np.array([arm.load] * 3 + [arm.load / 20] * 3)
    wrench = wrench * touching
    stiffness, friction = np.array(arm.stiffness), np.array(arm.friction)
    half = friction / stiffness
    # Springs, contact and friction balance; the arm stays where friction can hold it.
    positions = play(late(path) + wrench[:, :3] / stiffness[:3], half[:3])
    pushed = Rotation.from_rotvec(wrench[:, 3:] / stiffness[3:])
    rotations = turned_play(pushed * Rotation.from_rotvec(late(turns)) * base, half[3:])
    jitter = arm.angle_std * random.standard_normal((len(times), 3))
    rotations = Rotation.from_rotvec(jitter) * rotations
    forces, torques = sensed(arm, rotations, wrench[:, :3], wrench[:, 3:])
    noise = random.standard_normal((len(times), 6)) + arm.slow * smooth(random, times, 1.0, 6)
    return Log(
        Path("made.csv"),
        times,
        positions + arm.pose_std * random.standard_normal((len(times), 3)),
        rotations,
        forces + arm.force_std * noise[:, :3],
        torques + arm.torque_std * noise[:, 3:],
        commands,
        targets,
    )


def sensed(arm: Arm, rotations: Rotation, forces, torques):
    """What the sensor reads of forces and torques of the world about the end effector's origin."""
    into = rotations.inv()
    turn = Rotation.from_rotvec(arm.sensor_rotation)
    weight = into.apply([0.0, 0.0, arm.weight])
    force, torque = into.apply(forces), into.apply(torques)
    torque = torque - np.cross(np.array(arm.point), force)
    # The centre of mass counts from the point that torques are about.
    force, torque = force + weight, torque + np.cross(np.array(arm.centre), weight)
    force = arm.gain * turn.apply(force) + np.array(arm.force_bias)
    torque = arm.gain * turn.apply(torque) + np.array(arm.torque_bias)
    if arm.frame == "world":
        force, torque = rotations.apply(force), rotations.apply(torque)
    return arm.sign * force, arm.sign * torque


def resting(
    arm: Arm,
    seed: int,
    orientations: int = 8,
    seconds: float = 12.0,
    rate: float = 20.0,
    creep: float = 0.06,
    crosstalk: float = 0.0,
    tilt: float = np.pi,
) -> Log:
    """An arm without commands that rests in several orientations and turns between them.

    After each turn the sensor creeps by about `creep` newtons within 5 s, in a direction of its
    own; `crosstalk` is a further error of each orientation [N].
    """
    random = np.random.default_rng(seed)
    axes = random.standard_normal((orientations, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    poses = Rotation.from_rotvec(axes * random.uniform(0.3 * tilt, tilt, (orientations, 1)))
    still, turning = round(seconds * rate), round(2.0 * rate)
    quats, off = [], []
    for k in range(orientations):
        if k:
            way = (poses[k] * poses[k - 1].inv()).as_rotvec()
            share = np.linspace(0, 1, turning + 2)[1:-1, None]
            quats.append((Rotation.from_rotvec(share * way) * poses[k - 1]).as_quat())
            off.append(np.zeros((turning, 6)))
        quats.append(np.repeat(poses[k].as_quat()[None], still, axis=0))
        scale = np.array([1.0] * 3 + [0.02] * 3)
        start, fixed = random.standard_normal((2, 6)) * scale
        gone = np.exp(-np.arange(still)[:, None] / rate / 5.0)
        off.append(creep * start * gone + crosstalk * fixed)
    rotations = Rotation.from_quat(np.concatenate(quats))
    times = np.arange(len(rotations)) / rate
    nothing = np.zeros((len(times), 3))
    forces, torques = sensed(arm, rotations, nothing, nothing)
    noise = random.standard_normal((len(times), 6)) + arm.slow * smooth(random, times, 1.0, 6)
    extra = np.concatenate(off)
    return Log(
        Path("made.csv"),
        times,
        nothing + arm.pose_std * random.standard_normal((len(times), 3)),
        rotations,
        forces + arm.force_std * noise[:, :3] + extra[:, :3],
        torques + arm.torque_std * noise[:, 3:] + extra[:, 3:],
    )
