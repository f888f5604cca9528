"""The filter over a history in compiled loops: tensors in, tensors out."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.filtered import HistoryLikelihood, Steps, filter_history
from tpcd.belief.kalman import FAR, OUTLIER_SQUARE
from tpcd.belief.misfit import MisfitField
from tpcd.belief.setting import Setting
from tpcd.simulator import StepSettings, native

if TYPE_CHECKING:
    from tpcd.simulator.kernel_slopes import SceneSlopes


def compiled_filter(
    points_ee: Float[Tensor, "m p 2"],
    setting: Setting,
    misfit_sd: Float[Tensor, " m"],
    field: MisfitField,
    settings: StepSettings,
    least: Float[Tensor, " m"] | None = None,
    innovations: bool = False,
    steps: bool = False,
    by_theta: SceneSlopes | None = None,
) -> HistoryLikelihood:
    """The same as `filter_history`; particles that jam are left to it."""
    from tpcd.belief.kernel import explain_range
    from tpcd.belief.kernel_given import Found, Given, Measured
    from tpcd.simulator.kernel_slopes import SceneSlopes

    conditions, merged = setting.conditions, setting.merged
    count, n = len(misfit_sd), len(setting.used)
    terrains = conditions.offset.shape[-1]
    size = field.bumps * terrains
    highest = setting.highest_terms
    # What the transitions after each one can still add.
    rest = highest.flip(1).cumsum(1).flip(1)[:, 1:]
    rest = torch.cat((rest, rest.new_zeros(len(rest), 1)), dim=1)
    if least is None:
        least = misfit_sd.new_full((count,), -torch.inf)
    given = Given(
        *(
            value.contiguous().numpy()
            for value in _alike(conditions.target, conditions.stiffness, conditions.turn)
        ),
        *(
            value.contiguous().numpy()
            for value in _alike(
                conditions.normal,
                conditions.offset_seen,
                conditions.friction,
                conditions.compliance,
            )
        ),
        (conditions.warp if conditions.warps else conditions.warp[:, :, :0])
        .mT.contiguous()
        .numpy(),
        settings.substeps,
        settings.finest,
        settings.largest_turn,
        settings.follow_path,
    )
    rows = (merged.poses, merged.variance, conditions.give.expand(-1, n + 1, -1), rest)
    (seen,) = torch.broadcast_shapes(*(value.shape[:1] for value in rows))
    poses, variance, give, rest = (value.expand(seen, *value.shape[1:]) for value in rows)
    values, slopes = field.basis(setting.angles)
    measured = Measured(
        *(part.contiguous().numpy() for part in (poses, variance, give, values, slopes, rest)),
        least.contiguous().numpy(),
        misfit_sd.contiguous().numpy(),
        setting.used.numpy(),
        OUTLIER_SQUARE,
        FAR,
        field.grain,
        field.roughness,
    )
    total = torch.empty(count, dtype=torch.float64)
    mean = torch.zeros(count, size, dtype=torch.float64)
    covariance = torch.zeros(count, size, size, dtype=torch.float64)
    jammed = torch.zeros(count, dtype=torch.bool)
    shape = (count if innovations else 0, n, 3)
    whitened, log_scale = (total.new_full(shape, torch.nan) for _ in range(2))
    if by_theta is None:
        flat = np.zeros((1, 0, terrains))
        by_theta = SceneSlopes(np.zeros((1, 0, 2, 1)), flat, flat)
    slopes = total.new_full((shape[0], by_theta.offsets.shape[1], *shape[1:]), torch.nan)
    kept = (count if steps else 0, n)
    settled = Steps(
        total.new_full((*kept, 3), torch.nan),
        torch.zeros(*kept, terrains, dtype=torch.long),
        total.new_full((*kept, terrains, 4), torch.nan),
    )
    answers = (
        total,
        mean,
        covariance,
        jammed,
        whitened,
        log_scale,
        slopes,
        *vars(settled).values(),
    )
    found = Found(*(value.numpy() for value in answers))
    points = points_ee.detach().double().mT.contiguous().numpy()
    soft = (conditions.compliance != 0).flatten(1).any(-1).expand(count)
    for yielding, group in ((0, ~soft), (terrains, soft)):
        law, which = native.law_of(settings, yielding), torch.nonzero(group).flatten().numpy()
        explain = partial(explain_range, points, law, given, measured, by_theta, found, which)
        if len(which):
            native.in_parts(explain, len(which), n)
    answer = HistoryLikelihood(total, mean, covariance)
    if innovations:
        answer = replace(answer, whitened=whitened, log_scale=log_scale, slopes=slopes)
    if steps:
        answer = replace(answer, steps=settled)
    index = torch.nonzero(jammed).flatten()
    if len(index):
        part = filter_history(
            points_ee[index],
            setting[index],
            misfit_sd[index],
            field,
            settings,
            innovations,
            steps,
        )
        _put(answer, part, index)
    return answer


def _alike(*values: Tensor) -> list[Tensor]:
    """Values (m, r, ...) whose first two axes are made the same."""
    m, r = torch.broadcast_shapes(*(value.shape[:2] for value in values))
    return [value.expand(m, r, *value.shape[2:]) for value in values]


def _put(answer: HistoryLikelihood, part: HistoryLikelihood, index: Tensor) -> None:
    """Write the answers of some particles into those of all."""
    for name, value in vars(part).items():
        if isinstance(value, Steps):
            for own, into in zip(vars(value).values(), vars(answer.steps).values(), strict=True):
                into[index] = own
        elif value is not None:
            getattr(answer, name)[index] = value
