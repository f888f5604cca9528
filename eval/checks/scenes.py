"""Whether recordings of other scenes are told from their own, and what steps go into terrain."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from tests.contact_scenes import OUTLINES, make_scene, outline_points
from tpcd.belief.belief import estimate
from tpcd.belief.settings import EstimatorSettings, SamplerSettings
from tpcd.commands.fit import fit_of, learnt_fit
from tpcd.commands.prediction import measured_rows, predict_rows
from tpcd.contact import terrain_gaps
from tpcd.parameters import LARGEST_FRICTION
from tpcd.predict import ContactPredictor
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior
from tpcd.simulator import StepSettings, StepStatus, simulate_step
from tpcd.truth.make import make_truth
from tpcd.truth.recording import Policy, make_motion, record
from tpcd.truth.scene import draw_scene

PRIOR, PARTICLES, LEARNT, TESTED = "ycb21-z2", 100, 6, 20
OBJECTS = ("jam_jar", "soup_can", "milk_carton", "wine_bottle", "mug")
LAWS = {law: StepSettings(friction=law) for law in ("coulomb", "anitescu")}
MOVES, ELEMENTS = 3, 60


def fit_runs(seed: int) -> list[dict[str, Any]]:
    """A belief from six moves, and how it takes twenty of its own scene and of four others."""
    generator = torch.Generator().manual_seed(seed)
    own, other = (OBJECTS[(seed + k) % len(OBJECTS)] for k in (0, 1))

    def recorded(name: str, motion: Policy, steps: int, fixed: dict[str, float]) -> Any:
        scene = draw_scene(name, builtin_outlines()[name].vertices, generator, fixed=fixed)
        moves = make_motion(motion, scene, steps, generator)
        truth = make_truth(scene, "quasistatic")
        return scene, record(truth, scene, moves, steps, generator).measured

    scene, learnt = recorded(own, "rich", LEARNT, {})
    settings = EstimatorSettings(sampler=SamplerSettings(particles=PARTICLES))
    *_, last = estimate(learnt, load_prior(PRIOR), generator, settings)
    found = learnt_fit(learnt, last.belief)
    rows = [{"of": ["the rows it was learnt from"], "told": not (found["fits"] and found["known"])}]
    theta = scene.theta
    scenes = {
        "its own scene": (own, theta),
        "floor 10 mm higher": (own, theta | {"floor_height": theta["floor_height"] + 0.01}),
        "wall 10 mm nearer": (own, theta | {"wall_position": theta["wall_position"] - 0.01}),
        "held 10 mm lower": (own, theta | {"mount_z": theta["mount_z"] - 0.01}),
        "another object": (other, theta),
    }
    for case, (name, fixed) in scenes.items():
        _, test = recorded(name, "test", TESTED, fixed)
        predicted = predict_rows(ContactPredictor(last.belief), test)
        fit = fit_of(predicted, measured_rows(test)[1:], test.sensor_std)
        rows.append({"of": [case], "told": not fit["fits"]})
    return rows


def step_runs(seed: int) -> list[dict[str, Any]]:
    """Moves one after another over friction up to its bound, springs of 1e-3 to 1e9, commands far
    inside the terrain, and terrain that yields: what is wrong with answers whose status is good."""
    rows = []
    for law, settings in LAWS.items():
        generator = torch.Generator().manual_seed(seed)
        for name in OUTLINES:
            rows += _moves(law, settings, name, generator)
    return rows


def _moves(
    law: str, settings: StepSettings, name: str, generator: torch.Generator
) -> list[dict[str, Any]]:
    def uniform(low: float, high: float, *shape: int) -> Tensor:
        draw = torch.rand(ELEMENTS, *shape, generator=generator, dtype=torch.float64)
        return low + (high - low) * draw

    def log(low: float, high: float, *shape: int) -> Tensor:
        return uniform(math.log(low), math.log(high), *shape).exp()

    yields = torch.where(uniform(0, 1) < 0.3, log(1e-9, 1e-2), 0.0)[:, None]
    points = outline_points(name).expand(ELEMENTS, -1, 2)
    size = points.norm(dim=-1).amax(-1)
    scene = make_scene(points, log(1e-3, LARGEST_FRICTION), uniform(-0.02, 0.02), 0.3, yields)
    stiffness = log(1e-3, 1e9, 3)
    pose = torch.stack((uniform(-0.1, 0.1), uniform(0.0, 0.1) + size, uniform(-3, 3)), -1)
    previous, rows = pose, []
    for _ in range(MOVES):
        far = torch.where(uniform(0, 1) < 0.2, 10.0, 1.0)[:, None] * size[:, None]
        command = pose + torch.cat((far * uniform(-1, 1, 2), uniform(-0.5, 0.5, 1)), -1)
        found = simulate_step(
            scene, pose, command, stiffness, settings, previous=previous, unusual=True
        )
        good = found.status <= StepStatus.START_INSIDE
        gaps = terrain_gaps(scene, found.pose)
        depth = -(gaps.amin(-1) + scene.compliance * found.contacts[..., 0]).amin(-1)
        wrong = torch.stack((depth, found.residual))[:, good].nan_to_num(math.inf).amax(-1)
        row = {"of": [law], "steps": ELEMENTS, "good": int(good.sum())}
        rows.append(row | {"depth": float(wrong[0]), "residual": float(wrong[1])})
        keep = good[:, None]
        pose, previous = torch.where(keep, found.pose, pose), torch.where(keep, command, previous)
    return rows
