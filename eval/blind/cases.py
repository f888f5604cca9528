"""The world of a case: object, scene and hidden effects, and what is recorded in it.

Everything follows from the seed of the benchmark, the label and the run of the case. World,
motion and noise have streams of their own, none of which the workflow under test ever sees.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from eval.blind.suites import CLEAN, EFFECTS, MEDIUM, OUTSIDE, PAIR, PLACES, RANGES, Case
from eval.unseen import UNSEEN
from tpcd.data import Episode
from tpcd.data.checks import FREE_WRENCH, NOISE_FACTOR
from tpcd.discrepancy.report_parts import SIZES
from tpcd.effects import find_effect
from tpcd.random import stream
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.outline import Outline
from tpcd.shape.ycb import load_ycb, ycb_folder
from tpcd.truth.injected_effects import active_effects, sensor_effects
from tpcd.truth.protocol import Truth
from tpcd.truth.recording import DEFAULT_SENSOR_STD, Policy, Recording, make_motion, record
from tpcd.truth.scene import Scene, draw_scene

BUILTIN = ("mug", "book", "pear", "hammer", "soup_can", "jam_jar", "banana", "spray_bottle")
"""Objects where there are no YCB outlines."""
JITTER = (0.8, 1.2)
"""Sizes are drawn within this range of the nominal ones."""
FRESH_STEPS = 30
FRESH_POLICY: Policy = "test"
"""Motion of the episode on which the gap is measured, unlike any that effects are named from."""
_OBJECT, _SCENE, _EFFECTS, _MOTION, _NOISE, _START = range(6)

Hidden = dict[str, dict[str, float]]


@dataclass(frozen=True)
class World:
    """What nobody but the key knows."""

    scene: Scene
    hidden: Hidden
    """Effects with their parameters in SI units."""

    @property
    def size(self) -> dict[str, float]:
        """Extents of the held outline along the end effector's axes [m]."""
        points = self.scene.vertices_ee
        return dict(zip(SIZES, (points.amax(0) - points.amin(0)).tolist(), strict=True))

    def key(self) -> dict[str, Any]:
        """In plain values."""
        return {
            "object": self.scene.outline_name,
            "theta": self.scene.theta | self.size,
            "start_pose": self.scene.start_pose.tolist(),
            "hidden": self.hidden,
        }


@lru_cache(maxsize=1)
def outlines() -> dict[str, Outline]:
    """The objects: YCB ones that priors can be trained without, else built-in ones."""
    if ycb_folder() is not None:
        known, names = load_ycb("main"), UNSEEN
    else:
        known, names = builtin_outlines(), BUILTIN
    return {name: known[name] for name in names}


def draw_world(case: Case, seed: int) -> World:
    """Object, theta and effects of a case."""
    known = outlines()
    names = list(known)
    name = names[int(torch.randint(len(names), (), generator=_stream(_OBJECT, case, seed)))]
    scene = draw_scene(name, known[name].vertices, _stream(_SCENE, case, seed))
    generator = _stream(_EFFECTS, case, seed)
    effects = _effect_names(case.label, generator)
    scale = case.settings.scale
    return World(scene, {effect: draw_effect(effect, scale, generator) for effect in effects})


def draw_effect(name: str, scale: float, generator: torch.Generator) -> dict[str, float]:
    """Parameters of an effect: medium times `scale`, jittered, of either sign where it has two."""
    medium = MEDIUM.get(name) or OUTSIDE[name]
    sign = 1.0 if _uniform((0.0, 1.0), generator) < 0.5 else -1.0
    drawn = {}
    for parameter, value in medium.items():
        if (name, parameter) in RANGES:
            drawn[parameter] = _uniform(RANGES[name, parameter], generator)
            continue
        null, two_sided = null_value(name, parameter)
        size = (value - null) * _uniform(JITTER, generator) * (sign if two_sided else 1.0)
        drawn[parameter] = null + size * (1.0 if (name, parameter) in PLACES else scale)
    return drawn


def null_value(name: str, parameter: str) -> tuple[float, bool]:
    """Null value of a parameter, and whether it can lie on either side of it."""
    if name in OUTSIDE:
        return 0.0, (name, parameter) not in PLACES
    (found,) = (p for p in find_effect(name).parameters if p.name == parameter)
    return found.null, found.low < found.null < found.high


def record_case(world: World, case: Case, seed: int, fresh: bool = False) -> Recording:
    """The episode that the workflow is given, or the fresh one of the same world."""
    settings = case.settings
    steps = FRESH_STEPS if fresh else settings.steps
    truth = make_hidden_truth(world, settings.truth, steps)
    policy: Policy = FRESH_POLICY if fresh else settings.policy
    motion = make_motion(policy, world.scene, steps, _stream(_MOTION, case, seed, int(fresh)))
    noise = _stream(_NOISE, case, seed, int(fresh))
    std = settings.noise * torch.tensor(DEFAULT_SENSOR_STD, dtype=torch.float64)
    recording = record(truth, world.scene, motion, steps, noise, std)
    read = start_reading(world.hidden, world.scene.start_pose)
    return _with_start(recording, read, _stream(_START, case, seed, int(fresh)))


def make_hidden_truth(world: World, kind: str, steps: int) -> Truth:
    """A source of data of a world for a run of so many steps."""
    from tpcd.truth.make import make_truth

    return make_truth(world.scene, kind, world.hidden, steps)


def start_reading(
    hidden: Mapping[str, Mapping[str, float]], pose: Float[Tensor, " 3"]
) -> Float[Tensor, " 3"]:
    """What the sensor reads at the free start [N, N, N·m]: its own errors, and the payload."""
    effects = active_effects(hidden)
    weight, lever = (effects.get("payload", name) for name in ("weight", "lever"))
    torque = -weight * lever * float(pose[2].cos())
    load = torch.tensor([0.0, -weight, torque], dtype=torch.float64)
    return sensor_effects(hidden, pose, load, 0.0)[1]


def _with_start(
    recording: Recording, read: Float[Tensor, " 3"], generator: torch.Generator
) -> Recording:
    """Truths start from a wrench of zero; put there what the sensor would read.

    Noise stays, but is drawn anew where the format would refuse the row, as a person would
    measure again.
    """
    measured, std = recording.measured, recording.measured.sensor_std[3:]
    row = measured.wrenches[0] + read
    while bool((row.abs() > NOISE_FACTOR * std + FREE_WRENCH).any()):
        row = read + std * torch.randn(3, generator=generator, dtype=torch.float64)

    def starting(episode: Episode, wrench: Tensor) -> Episode:
        return replace(episode, wrenches=torch.cat((wrench[None], episode.wrenches[1:])))

    return replace(recording, measured=starting(measured, row), true=starting(recording.true, read))


def _effect_names(label: str, generator: torch.Generator) -> tuple[str, ...]:
    if label == CLEAN:
        return ()
    if label != PAIR:
        return (label,)
    first = EFFECTS[int(torch.randint(len(EFFECTS), (), generator=generator))]
    others = [e for e in EFFECTS if find_effect(e).site != find_effect(first).site]
    return first, others[int(torch.randint(len(others), (), generator=generator))]


def _uniform(ends: tuple[float, float], generator: torch.Generator) -> float:
    draw = float(torch.rand((), generator=generator, dtype=torch.float64))
    return ends[0] + (ends[1] - ends[0]) * draw


def _stream(what: int, case: Case, seed: int, *more: int) -> torch.Generator:
    # Not of the suite: its cases share their worlds with those of others.
    return stream(seed, what, zlib.crc32(case.label.encode()), case.run, *more)
