"""The posterior that a diagnosis reports: as wide as its power of the likelihood makes it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tpcd.belief.history import joined_history
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import SamplerSettings
from tpcd.discrepancy import conclude
from tpcd.discrepancy.coverage import coverage_of
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question, posterior
from tpcd.discrepancy.settings import REPORTED_SEEDS, DiagnosisSettings
from tpcd.discrepancy.workbench import Workbench
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

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


def test_reported_intervals_are_wider_and_hold_the_same_place(
    bench: Workbench, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = fit_model(bench.question, (), range(6))
    # Fewer seeds have too few draws for a width.
    monkeypatch.setattr(conclude, "ENOUGH_DRAWS", 1e9)
    told = conclude._reported(bench, bench.question, fit, range(40, 46))
    own = posterior(bench.question, fit)
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
    found = conclude._reported(bench, bench.question, fit, REPORTED_SEEDS)
    torch.testing.assert_close(found.mean(), posterior(bench.question, fit).mean())
    note = "intervals are too narrow, the last fit failed: ValueError: no draw at all"
    assert bench.notes == [note]


@pytest.mark.parametrize(
    ("draws", "used", "warned"),
    [([30, 30, 1], 2, False), ([9, 9, 9, 9], 4, False), ([1] * 4, 4, True)],
)
def test_a_posterior_is_drawn_on_further_seeds_while_few_draws_count(
    draws: list[float], used: int, warned: bool, bench: Workbench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So many on each seed; seeds of equal evidence add up."""
    fit = fit_model(bench.question, (), (0,))
    asked: list[int] = []

    def fitted(question: Question, effects, seeds: tuple[int], *, power: float, **_: object) -> Fit:
        assert power == conclude.POWER
        asked.extend(seeds)
        cloud = replace(fit.clouds[0], log_evidence_std=draws[len(asked) - 1] ** -0.5)
        return replace(fit, clouds=(cloud,))

    bench.notes.clear()
    monkeypatch.setattr(conclude, "fit_model", fitted)
    belief = conclude._reported(bench, bench.question, fit, REPORTED_SEEDS)
    assert asked == list(REPORTED_SEEDS[:used])
    assert belief.log_evidence_std**-2 == pytest.approx(sum(draws[:used]))
    assert any("rests on about" in note for note in bench.notes) == warned
