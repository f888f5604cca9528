"""A workbench of a diagnosis on a short recording, for tests of its stages."""

from __future__ import annotations

from dataclasses import replace

import torch

from tpcd.belief.history import joined_history
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.data.episode import Episode
from tpcd.discrepancy.coverage import coverage_of
from tpcd.discrepancy.fit import FIT_SAMPLER, Question
from tpcd.discrepancy.search import DiagnosisSettings
from tpcd.discrepancy.workbench import Workbench
from tpcd.effects import find_effect
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

CATALOGUE = tuple(find_effect(n) for n in ("floor_compliance", "wall_friction", "wall_tilt"))
SETTINGS = DiagnosisSettings(
    sampler=replace(
        FIT_SAMPLER,
        particles=60,
        draws_per_place=9,
        draws=200,
        prior_draws=100,
        fresh_modes=10,
        modes=4,
        rounds=1,
        places=20,
    ),
    catalogue=CATALOGUE,
)


def far_from_the_wall() -> Episode:
    """Steps that never slide along the wall."""
    generator = torch.Generator().manual_seed(5)
    outline = builtin_outlines()["mug"].vertices
    scene = replace(draw_scene("mug", outline, generator), wall_position=2.0)
    truth = make_truth(scene, "quasistatic")
    motion = make_motion("rich", scene, 16, generator)
    found = record(truth, scene, motion, 16, generator).measured
    assert coverage_of([found]).missing(find_effect("wall_friction").needs)
    return found


def bench_of(episode: Episode) -> Workbench:
    question = Question(
        joined_history([episode]), make_prior(PolygonShape(builtin_outlines()["mug"])),
        MisfitField(0.0), StepSettings(), SETTINGS.sampler,
    )  # fmt: skip
    return Workbench(question, SETTINGS, coverage_of([episode]), 0, lambda line: None)
