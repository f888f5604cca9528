"""The posterior that a diagnosis reports: as wide as its power of the likelihood makes it."""

from __future__ import annotations

import pytest
import torch

from tpcd.belief.history import joined_history
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import SamplerSettings
from tpcd.discrepancy import conclude
from tpcd.discrepancy.coverage import coverage_of
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Question, posterior
from tpcd.discrepancy.settings import DiagnosisSettings
from tpcd.discrepancy.workbench import Workbench
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene, make_truth

SAMPLER = SamplerSettings(
    rough=False,
    particles=400,
    draws=6000,
    draws_per_place=9,
    prior_draws=200,
    fresh_modes=20,
    modes=20,
    places=60,
)


@pytest.fixture(scope="module")
def bench() -> Workbench:
    """A mug of known outline, with the lines that are told in its notes."""
    outline = builtin_outlines()["mug"]
    generator = torch.Generator().manual_seed(5)
    scene = draw_scene("mug", outline.vertices, generator)
    truth = make_truth(scene, "quasistatic")
    motion = make_motion("diagnosis", scene, 20, generator)
    episode = record(truth, scene, motion, 20, generator).measured
    question = Question(
        joined_history([episode]),
        make_prior(PolygonShape(outline)),
        MisfitField(0.0),
        StepSettings(),
        SAMPLER,
    )
    settings = DiagnosisSettings(sampler=SAMPLER)
    return Workbench(question, settings, coverage_of([episode]), 0, lambda line: None)


def test_reported_intervals_are_wider_and_hold_the_same_place(bench: Workbench) -> None:
    fit = fit_model(bench.question, (), range(6))
    # Fewer seeds have too few draws for a width.
    own, told = posterior(bench.question, fit), conclude._reported(bench, fit, range(40, 46))
    wider = (told.std() / own.std()).log().mean().exp()
    # 1 / sqrt(0.6) = 1.29, and less where the prior bounds or carries it: 1.12 to 1.20 for six
    # sets of seeds; a quarter of the draws leave it between 1.00 and 1.30.
    assert 1.05 < float(wider) < 1.29
    assert ((told.mean() - own.mean()).abs() < 2 * own.std()).all()
    assert told.log_evidence == fit.log_evidence


def test_a_last_fit_that_fails_leaves_the_narrow_one_and_says_so(
    bench: Workbench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ValueError("no draw at all")

    fit = fit_model(bench.question, (), (0,))
    monkeypatch.setattr(conclude, "fit_model", broken)
    found = conclude._reported(bench, fit, conclude.SEEDS)
    torch.testing.assert_close(found.mean(), posterior(bench.question, fit).mean())
    assert "intervals are too narrow: ValueError in the last fit: no draw at all" in bench.notes
