"""Streams of a recording as sensors of some noise and resolution would make them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from tests.made_logs import SAMPLE_STD, Setting, an_episode, in_space, sampled
from tpcd.quality.finding import Finding, Weight
from tpcd.quality.stream import Stream

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
WRENCH = ("F_x", "F_y", "F_z", "T_x", "T_y", "T_z")
SET_POINT = ("u_x", "u_y", "u_z")
STEPS = np.array([1e-4] * 7 + [0.2] * 3 + [0.01] * 3)
"""One standard deviation of each channel of pose and wrench, about."""
TURNED = Setting(
    base=Rotation.from_euler("xyz", [0.3, 0.5, 2.0]),
    tool=Rotation.from_euler("xyz", [3.0, 0.2, 0.1]),
    in_tool=True,
)
"""An arm whose axes are none of the plane's, so that all channels move."""


@cache
def quiet_episode():
    return an_episode()


def made_stream(
    noise: float = 1.0, steps: float = 0.0, seed: int = 0, setting: Setting = TURNED
) -> Stream:
    """A recording whose noise and resolution are so many times the usual noise."""
    samples = sampled(quiet_episode(), seed)
    clean = _without_noise(samples, seed)
    for name in ("pose", "wrench"):
        samples[name] = clean[name] + noise * (samples[name] - clean[name])
    space = in_space(samples, setting)
    values = np.column_stack(
        [space[name] for name in ("position", "rotation", "force", "torque", "target")]
    )
    if steps:
        values[:, :13] = np.round(values[:, :13] / (steps * STEPS)) * (steps * STEPS)
    return Stream("made", (*POSE, *WRENCH, *SET_POINT), space["time"], values)


def _without_noise(samples, seed):
    """Pose and wrench without the noise that was drawn with that seed."""
    drawn = np.array(SAMPLE_STD) * np.random.default_rng(seed).standard_normal(
        (len(samples["u"]), 6)
    )
    return {"pose": samples["pose"] - drawn[:, :3], "wrench": samples["wrench"] - drawn[:, 3:]}


def changed(stream: Stream, name: str, first: int, end: int, value) -> Stream:
    """The stream with another number in samples of a channel."""
    values = stream.values.copy()
    values[first:end, stream.channels.index(name)] = value
    return replace(stream, values=values)


def frozen(stream: Stream, names: tuple[str, ...], first: int, end: int) -> Stream:
    """The stream with channels that repeat the number of their first sample."""
    for name in names:
        stream = changed(
            stream, name, first, end, stream.values[first, stream.channels.index(name)]
        )
    return stream


def alarms(findings: tuple[Finding, ...]) -> list[Finding]:
    """What is not merely noted."""
    return [each for each in findings if each.weight is not Weight.NOTE]
