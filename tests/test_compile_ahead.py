"""Compiling ahead: what it makes is what estimation then takes."""

from __future__ import annotations

import subprocess
import sys

# Counts what numba compiles or loads for an estimate that comes after.
USE = """
import torch
from tpcd.belief import EstimatorSettings, SamplerSettings, estimate
from tpcd.belief import kernel as filtered, mixture_kernel
from tpcd.compile_ahead import compile_loops
from tpcd.contact import scene_from_parameters
from tpcd.effects.catalogue import find_effect
from tpcd.effects.kernel_uneven import lay_range
from tpcd.predict import ContactPredictor
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior
from tpcd.simulator import batch, simulate_step
from tpcd.truth.recording import make_motion, record
from tpcd.truth.make import make_truth
from tpcd.truth.scene import draw_scene

compile_loops()
loops = (batch.step_range, filtered.explain_range, mixture_kernel.sum_range, lay_range)
before = [len(loop.signatures) for loop in loops]
generator = torch.Generator().manual_seed(1)
scene = draw_scene("milk_carton", builtin_outlines()["milk_carton"].vertices, generator)
motion = make_motion("rich", scene, 2, generator)
episode = record(make_truth(scene, "quasistatic"), scene, motion, 2, generator).measured
other = (("wall_compliance", "grasp_compliance"), ("floor_height ~ bump",))
for effects in ((), *(tuple(map(find_effect, names)) for names in other)):
    settings = EstimatorSettings(sampler=SamplerSettings(particles=50), effects=effects)
    *_, last = estimate(episode, load_prior("ycb-rich"), generator, settings)
    ContactPredictor(last.belief).predict(episode.poses[:1], episode.commands[1:2])
    belief = last.belief
    one = scene_from_parameters(belief.prior.shape, belief.prior.parameters_of(belief.vectors[:1]))
    simulate_step(one, episode.poses[:2], episode.commands[1:], episode.stiffness)
print(before, [len(loop.signatures) for loop in loops])
"""


def test_nothing_is_left_to_compile_for_an_estimate() -> None:
    found = subprocess.run(
        [sys.executable, "-c", USE], capture_output=True, text=True, check=False, timeout=500
    )
    assert found.stdout.strip() == "[2, 2, 1, 1] [2, 2, 1, 1]", found.stderr
