"""Does a model explain the data at all? Tests of what it leaves, without an alternative.

Under a true model the innovations of the filter are independent standard normal numbers, for
every particle of the posterior, and so is what pose and wrench say about each other, w - K (x - u)
in units of its noise (parity). Innovations, in x, z and phi, are of the pose that both readings
tell together, to which a wrench may add little; parity, in F_x, F_z and tau, is what is left of
the wrench. Cells of contact mode x channel x covariate ask whether any kind of transition departs
from that, with the largest score compared to the largest of all cells in draws of standard normal
numbers (max-T: Westfall and Young 1993). Innovations at the filter's border, which a model does
not explain, are counted apart: stick and slip make a few of them under a true model too.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.filter import filter_history
from tpcd.belief.history import History
from tpcd.belief.kernel_given import OUTLIER_SQUARE
from tpcd.belief.likelihood import effective_setting, outcome_of
from tpcd.contact import scene_from_parameters
from tpcd.discrepancy.diagnosis import CHANNELS, Cell
from tpcd.discrepancy.fit import Fit, Question
from tpcd.effects.conditions import FLOOR, WALL, Outcome

DRAWS = 4000
"""Draws of standard normal numbers for the largest score."""
PARTICLES = 40
TOLD_ROWS = 6
"""Rows of those that are not explained which a sentence names."""
FEWEST = 4
"""A cell needs so many transitions."""
EXPECTED_UNEXPLAINED = 0.03
"""Share of transitions that a true model leaves at the border: stick and slip hang on less than
anything that is measured."""
COVARIATES = ("mean", "size", "load", "place", "angle", "time")


@dataclass(frozen=True)
class Adequacy:
    """What a model leaves."""

    unexplained: float
    """Share of transitions beyond the border of the filter."""
    unexplained_p: float
    """Probability of as many under a true model."""
    cells_p: float
    """Probability of as large a largest score under a true model."""
    cells: tuple[Cell, ...]
    """The cells, those with the largest scores first."""
    beyond: tuple[tuple[int, str], ...] = ()
    """Rows, counted through all episodes, that lie beyond the border for more than half of the
    posterior, and what they touch."""
    limit: float = math.inf
    """The largest score that one in a thousand true models has."""

    def adequate(self, level: float) -> bool:
        """Whether nothing departs at this level."""
        return self.unexplained_p > level and self.cells_p > level

    def left(self, level: float) -> str:
        """What departs at this level, in words; empty where nothing does."""
        told = []
        if self.unexplained_p <= level:
            text = f"{self.unexplained:.0%} of the transitions are not explained"
            if self.beyond:
                rows = [str(row) for row, _ in self.beyond[:TOLD_ROWS]]
                more = " and more" if len(self.beyond) > TOLD_ROWS else ""
                (mode, count), *_ = Counter(mode for _, mode in self.beyond).most_common(1)
                text += f" (rows {', '.join(rows)}{more}; {count} of {len(self.beyond)}: {mode})"
            told.append(text)
        if self.cells and self.cells_p <= level:
            # What goes with something says more than that it scatters.
            clear = (c for c in self.cells if c.covariate != "size" and abs(c.score) > self.limit)
            told.append(next(clear, self.cells[0]).words)
        return "; ".join(told)


def check_adequacy(question: Question, fit: Fit, generator: torch.Generator) -> Adequacy:
    """Test innovations and parity of the posterior's best particles."""
    whitened, parity, outcome, weights = _residuals(question, fit)
    history = question.history
    used = history.used
    square = (whitened**2).sum(-1)
    border = (square > OUTLIER_SQUARE - 1e-6).double()
    count = int(used.sum())
    unexplained = float((weights @ border)[used].sum()) / max(count, 1)
    modes = _modes(outcome)[1:]
    explained = (1.0 - border) * used
    designs, names = _designs(history, outcome, modes, used)
    values = torch.where(explained[..., None] > 0, whitened.nan_to_num(0.0), 0.0)
    mean = (weights[:, None, None] * torch.cat((values, parity), dim=-1)).sum(0)
    shares = (weights @ explained, (used & history.read[1:]).double())
    noise = torch.randn(DRAWS, count, len(CHANNELS), generator=generator, dtype=torch.float64)
    full = noise.new_zeros(DRAWS, len(used), len(CHANNELS))
    full[:, used] = noise
    scores, largest = [], torch.zeros(DRAWS, dtype=torch.float64)
    for (mode, covariate), design in zip(names, designs, strict=True):
        for c, channel in enumerate(CHANNELS):
            weight = design * shares[c // 3].sqrt()
            norm = float(weight.norm())
            if norm == 0:
                continue
            data, drawn = mean[:, c], full[:, :, c]
            if covariate == "size":
                # The posterior's mean makes squares smaller; only large ones speak.
                score = max(float(_size_score(data, weight)), 0.0)
                scored = _size_score(drawn, weight).clamp_min(0.0)
            else:
                score, scored = float(weight @ data) / norm, drawn @ weight / norm
            largest = torch.maximum(largest, scored.abs())
            scores.append(Cell(mode, channel, covariate, score, int((design != 0).sum())))
    scores.sort(key=lambda cell: -abs(cell.score))
    top = abs(scores[0].score) if scores else 0.0
    return Adequacy(
        unexplained,
        _at_least(round(unexplained * count), count, EXPECTED_UNEXPLAINED),
        float((largest >= top).double().mean()),
        tuple(scores),
        tuple(
            (row + 1, modes[row])
            for row in torch.nonzero(used & (weights @ border > 0.5)).flatten().tolist()
        ),
        float(largest.quantile(0.999)),
    )


def _residuals(
    question: Question, fit: Fit
) -> tuple[Float[Tensor, "m n 3"], Float[Tensor, "m n 3"], Outcome, Float[Tensor, " m"]]:
    """Innovations and parity of the best particles, how their rows settle (the best one's), and
    weights."""
    order = fit.cloud.weights.argsort(descending=True)[:PARTICLES]
    positions = fit.cloud.positions[order]
    weights = fit.cloud.weights[order] / fit.cloud.weights[order].sum()
    prior, history = fit.prior, question.history
    vectors = prior.to_vector(positions[:, :-1])
    sd = question.misfit.sd_of(positions[:, -1])
    scene = scene_from_parameters(prior.shape, prior.parameters_of(vectors))
    added = prior.added_of(vectors)
    setting, _ = effective_setting(scene, history, sd, question.misfit, fit.step, added)
    found = filter_history(
        scene.points_ee, setting, sd, question.misfit, fit.step, innovations=True, steps=True
    )
    assert found.whitened is not None and found.steps is not None
    outcome = outcome_of(found.steps, history, setting.used, scene.points_ee)
    parity = setting.merged.standard_parity(history.read)[0][:, 1:]
    return found.whitened, parity.expand(len(weights), -1, -1), outcome[:1], weights


def _size_score(values: Tensor, weight: Tensor) -> Tensor:
    """A sum of squares as a standard normal number (Wilson and Hilferty 1931)."""
    square = weight**2
    freedom = square.sum() ** 2 / (square**2).sum()
    mean = (values**2 @ square) / square.sum()
    spread = 2.0 / (9.0 * freedom)
    return (mean ** (1.0 / 3.0) - (1.0 - spread)) / spread.sqrt()


def _modes(outcome: Outcome) -> list[str]:
    """The contact mode of every row in words, of the first particle."""
    words = []
    for mode in outcome.mode[0].tolist():
        floor, wall = mode[FLOOR], mode[WALL]
        if floor and wall:
            words.append("corner")
        elif floor:
            words.append("floor, " + ("stick", "slides right", "slides left")[floor - 1])
        elif wall:
            words.append("wall, " + ("stick", "slides up", "slides down")[wall - 1])
        else:
            words.append("free")
    return words


def _designs(
    history: History, outcome: Outcome, modes: list[str], used: Tensor
) -> tuple[list[Tensor], list[tuple[str, str]]]:
    """Weights (n) of the transitions in every cell, and mode and covariate of the cells. Covariates
    are what the model says of a row and not what was read: where contact holds an object, readings
    of its place differ by noise alone, of which the row's innovation has its part. (Where a row
    tells much of the outline, as at a first contact, the model says it with that learnt.)"""
    load = outcome.load[0, 1:].sum(-1)
    values = {
        "mean": torch.ones_like(load),
        "size": torch.ones_like(load),
        "load": load,
        "place": outcome.pose[0, 1:, 0],
        "angle": outcome.pose[0, 1:, 2],
        "time": history.rows.share[1:],
    }
    designs, names = [], []
    groups = {"all": used, **{m: used & torch.tensor([k == m for k in modes]) for m in set(modes)}}
    for mode, rows in sorted(groups.items()):
        if int(rows.sum()) < FEWEST:
            continue
        for covariate in COVARIATES:
            value = values[covariate]
            if covariate not in ("mean", "size"):
                value = value - value[rows].mean()
            designs.append(torch.where(rows, value, 0.0))
            names.append((mode, covariate))
    return designs, names


def _at_least(found: int, count: int, share: float) -> float:
    """Probability of at least so many of `count` when each has the probability `share`."""
    from scipy.stats import binom

    return float(binom.sf(found - 1, count, share))
