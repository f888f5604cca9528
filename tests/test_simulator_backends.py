"""Steps whose contact problems another backend solves: the same rows, and errors that are told."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from contact_scenes import STIFFNESS, many_random_transitions

from tpcd.belief import EstimatorSettings, SamplerSettings, estimate
from tpcd.belief.belief import Belief
from tpcd.belief.paper import PAPER_STEP, PaperSettings, estimate_paper
from tpcd.data.episode import Episode
from tpcd.errors import SolverError
from tpcd.qp import ContactQP, QPSolution, solve
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings, StepStatus, backends, simulate_step
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

ONCE = StepSettings(friction="anitescu", substeps=1)
LAWS = pytest.mark.parametrize(
    "settings", [ONCE, StepSettings(substeps=1), StepSettings()], ids=["convex", "once", "path"]
)


def given_to(monkeypatch: pytest.MonkeyPatch, error: float) -> list[int]:
    """Let the native backend solve what goes to qpth, wrong by so much of each motion; how many
    problems were solved at once comes back."""
    sizes: list[int] = []

    def solved(problem: ContactQP, backend: str, elastic: bool) -> QPSolution:
        assert backend == "qpth" and not elastic
        found = solve(problem, elastic=False)
        sizes.append(len(found.status))
        return replace(found, motion=found.motion * (1 + error))

    monkeypatch.setattr(backends, "solve", solved)
    return sizes


@LAWS
def test_the_same_solutions_make_the_same_answer(
    settings: StepSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Batches that shrink, elements that take their time, and gradients."""
    sizes = given_to(monkeypatch, 0.0)
    scene, start, command = many_random_transitions(6, seed=5)
    command = command.requires_grad_()
    answers = [
        simulate_step(scene, start, command, STIFFNESS, replace(settings, solver=solver))
        for solver in ("native", "qpth")
    ]
    own, other = answers
    torch.testing.assert_close(other.pose, own.pose, atol=1e-9, rtol=0)
    assert torch.equal(other.status, own.status) and torch.equal(other.mode, own.mode)
    slopes = [torch.autograd.grad(each.pose.sum(), command)[0] for each in answers]
    torch.testing.assert_close(*slopes, atol=1e-6, rtol=1e-6)
    assert sizes[0] > sizes[-1] > 0


def test_what_a_backend_gets_wrong_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    given_to(monkeypatch, 0.01)
    scene, start, command = many_random_transitions(6, seed=5)
    found = simulate_step(scene, start, command, STIFFNESS, replace(ONCE, solver="qpth"))
    right = simulate_step(scene, start, command, STIFFNESS, ONCE)
    wrong = (found.pose - right.pose).abs().amax(-1) > 1e-5
    assert int(wrong.sum()) > 20
    assert (found.status[wrong] == StepStatus.NOT_CONVERGED).all()
    assert (found.residual[wrong] > 1e-6).all()


def test_a_backend_that_is_none_or_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises((ValueError, TypeError), match="'solver': 'osqp'|expected one of native"):
        StepSettings(solver="osqp")  # type: ignore[arg-type]
    monkeypatch.setattr("tpcd.qp.qpth_backend.find_spec", lambda name: None)
    scene, start, command = many_random_transitions(1, seed=5)
    with pytest.raises(SolverError, match="qpth is not installed"):
        simulate_step(scene, start, command, STIFFNESS, StepSettings(solver="qpth"))


@LAWS
def test_qpth_settles_where_the_active_set_does(settings: StepSettings) -> None:
    """All but a few, on whose way it decided otherwise; what it did not settle says so."""
    pytest.importorskip("qpth", reason="the extra qpth is not installed")
    scene, start, command = many_random_transitions(4, seed=5)
    own = simulate_step(scene, start, command, STIFFNESS, settings)
    found = simulate_step(scene, start, command, STIFFNESS, replace(settings, solver="qpth"))
    good = found.status <= StepStatus.START_INSIDE
    assert float(good.double().mean()) > 0.95
    near = (found.pose - own.pose).abs().amax(-1) < 1e-5
    assert float(near[good].double().mean()) > (0.95 if settings.substeps > 1 else 1 - 1e-9)
    assert (found.residual[good] <= 1e-6).all()


@pytest.fixture(scope="module")
def episode() -> Episode:
    generator = torch.Generator().manual_seed(1)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    motion = make_motion("rich", scene, 2, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 2, generator).measured


def test_both_estimators_learn_with_qpth(episode: Episode) -> None:
    """From two moves, the same as with the active-set method but for rounding, which a sampler
    answers with other draws."""
    pytest.importorskip("qpth", reason="the extra qpth is not installed")
    shape, sampler = PolygonShape(builtin_outlines()["mug"]), SamplerSettings().scaled(0.0)
    beliefs = []
    for solver in ("native", "qpth"):
        step = StepSettings(substeps=1, solver=solver)
        settings = EstimatorSettings(sampler=replace(sampler, particles=16), step=step)
        *_, last = estimate(episode, shape, torch.Generator().manual_seed(0), settings)
        paper = PaperSettings(particles=50, step=replace(PAPER_STEP, solver=solver))
        *_, filtered = estimate_paper(episode, shape, torch.Generator().manual_seed(0), paper)
        beliefs.append((last.belief, filtered.belief))
    for own, other in zip(*beliefs, strict=True):
        (mean, std), (found, _) = (_moments(belief) for belief in (own, other))
        assert ((found - mean).abs() < 3 * std).all()


def _moments(belief: Belief) -> tuple[torch.Tensor, torch.Tensor]:
    mean = belief.weights @ belief.vectors
    return mean, (belief.weights @ (belief.vectors - mean) ** 2).sqrt() + 1e-9
