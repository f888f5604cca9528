"""How models of a diagnosis are weighed against each other, and what a failure costs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tpcd.belief.prior import make_prior
from tpcd.discrepancy import workbench
from tpcd.discrepancy.coverage import Coverage
from tpcd.discrepancy.fit import Fit, Question
from tpcd.discrepancy.settings import DiagnosisSettings
from tpcd.discrepancy.workbench import Workbench, each_of, fitted_again, stands
from tpcd.effects import find_effect
from tpcd.errors import RunError
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings

PRIOR = make_prior(PolygonShape(builtin_outlines()["mug"]))
TILT, DRIFT = find_effect("floor_tilt"), find_effect("floor_drift")


def bench_of(told: list[str]) -> Workbench:
    return Workbench(Question.__new__(Question), DiagnosisSettings(), Coverage({}), 0, told.append)


def fit(*by_seed: float) -> Fit:
    return Fit((TILT,), StepSettings(), PRIOR, by_seed, ())


@pytest.mark.parametrize(
    ("by_seed", "held", "accepted", "reason"),
    [
        ((130.0, 130.0), None, True, "gain 30.0"),
        ((105.9, 105.9), 1.0, False, "gain 5.9"),
        ((107.0, 107.0), 0.3, True, "gain 7.0, held-out gain at least +0.30 a transition"),
        ((107.0, 107.0), -0.3, False, "gain 7.0, held-out gain at least -0.30 a transition"),
        ((107.0, 107.0), None, False, "gain 7.0, not told on blocks held out"),
        ((130.0, 101.0), None, False, "gain 30.0, on a second seed 1.0"),
        ((130.0, 101.0, 104.1), None, True, "gain 30.0"),
        ((130.0,), None, False, "gain 30.0, on a second seed -inf"),
    ],
)
def test_a_model_stands_where_two_seeds_and_blocks_held_out_say_so(
    by_seed: tuple[float, ...],
    held: float | None,
    accepted: bool,
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The model without it has 100 nats; 6 are asked. None: blocks held out have no answer."""

    def scores(question: Question, of: Fit) -> torch.Tensor:
        if held is None:
            raise ValueError("no draw at all")
        return torch.full((20,), held if of.by_seed == by_seed else 0.0, dtype=torch.float64)

    monkeypatch.setattr(workbench, "held_out_scores", scores)
    assert stands(bench_of([]), fit(*by_seed), fit(100.0), 6.0, 1) == (accepted, reason)


def test_a_fit_that_fails_when_made_again_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []

    def broken(*_: object, **__: object) -> Fit:
        raise ValueError("no particle explains it")

    monkeypatch.setattr(workbench, "fit_model", broken)
    whole = fit(0.0)
    assert fitted_again(bench_of(told), whole, 1, ()) is whole
    assert told == [
        "warning: floor_tilt failed when fitted again: ValueError: no particle explains it"
    ]


@pytest.mark.parametrize("error", [RunError(Path("f"), "cannot be read"), OSError("disk full")])
def test_what_is_wrong_with_files_is_no_fault_of_a_model(error: Exception) -> None:
    """It would make the runner-up win, and would be forgotten."""
    told: list[str] = []

    def work(effect: object) -> str:
        if effect is TILT:
            raise error
        return "done"

    with pytest.raises(type(error)):
        each_of(bench_of(told), (DRIFT, TILT), 1, work)
    assert told == []
