"""Extended Kalman filter over the transitions, for given theta and batches of particles.

The unknowns that theta leaves are linear and normal: the coefficients c of the misfit field,
and the error e_k of each estimated pose, poses[k] = true pose + e_k with e_k ~ N(0, R_k). A
transition starts at the filtered pose s = poses[k - 1] - E[e_{k-1}], with terrains as far away
as the filtered field g = E[c] says, and leaves the residual

    r_k = poses[k] - f(s, g, u_k) + H_k g = e_k - F_k (e_{k-1} - E[e_{k-1}]) + H_k c + v_k,

with F = d pose / d start, H from `misfit_rows` and v_k ~ N(0, V_k) what each reading's outline
has besides. So one reading's error is in two residuals, and the state (c, e_{k-1}) is carried
from one transition to the next. In free motion the arm reaches its command, and what was read
there no longer matters. The innovations give the likelihood of theta term by term, and the
state the posterior of the field (Kalman 1960; Rao-Blackwellised particle filters).

Contact is anything but linear where the field is unknown by millimetres: a terrain taken to be
there may not be touched where it is. So a transition that moves a gap far is stepped again with
the terrain where the state after it says, and brought in from there (Bell and Cathey 1993: the
iterated filter is Gauss and Newton's method), unless it is not explained from there. A terrain
that theta and the field leave untouched has no derivative to say that it is nearer: where the
object was held back before it, and this is not explained, the transition is stepped again with
that terrain just touched at the pose that was read, if this is likelier.

A transition far outside of what theta and the field allow (an object wedged between floor
and wall, a bad reading) has its innovation covariance grown until the innovation lies at the
border: its log likelihood then falls with the logarithm of the distance, as for a Student
distribution, and it no longer bends the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.belief.kernel_given import FAR, OUTLIER_SQUARE
from tpcd.belief.misfit import MisfitField
from tpcd.belief.setting import Setting
from tpcd.geometry.surfaces import HalfPlanes
from tpcd.simulator import StepSettings
from tpcd.simulator.engine import law_of
from tpcd.threads import in_parts

if TYPE_CHECKING:
    from tpcd.belief.kernel_given import SceneSlopes
    from tpcd.simulator.workspace import Law, Tape


@dataclass(frozen=True)
class Steps:
    """How the n transitions of m particles settled; NaN (mode: zero) where one was
    not stepped."""

    pose: Float[Tensor, "m n 3"]
    mode: Int[Tensor, "m n t"]
    contacts: Float[Tensor, "m n t 4"]
    """As in `Transition`."""


@dataclass(frozen=True)
class HistoryLikelihood:
    """What theta says about a history, m particles.

    `total` is the log likelihood, -inf for a particle that was given up; `field_mean` and
    `field_covariance` are the normal posterior of the misfit coefficients. Where they are asked
    for, `whitened` and `log_scale` are the innovations of the n transitions (see
    below), NaN without one, and `slopes` the derivatives of `whitened` by d
    coordinates; `steps` how the transitions settled.
    """

    total: Float[Tensor, " m"]
    field_mean: Float[Tensor, "m c"]
    field_covariance: Float[Tensor, "m c c"]
    whitened: Float[Tensor, "m n 3"] | None = None
    log_scale: Float[Tensor, "m n 3"] | None = None
    slopes: Float[Tensor, "m d n 3"] | None = None
    steps: Steps | None = None

    def __getitem__(self, index: Tensor | slice) -> HistoryLikelihood:
        """Of some particles, without how their transitions settled."""
        values = {name: v[index] for name, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **values, steps=None)


def joined(parts: Sequence[HistoryLikelihood]) -> HistoryLikelihood:
    """What is said of some particles after another, all asked the same."""
    whole = {}
    for name, first in vars(parts[0]).items():
        values = [getattr(part, name) for part in parts]
        if isinstance(first, Steps):
            ways = zip(*(vars(value).values() for value in values), strict=True)
            whole[name] = Steps(*(torch.cat(way) for way in ways))
        else:
            whole[name] = None if first is None else torch.cat(values)
    return HistoryLikelihood(**whole)


def filter_history(
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
    """Step and filter all transitions that count, for outlines in the end-effector frame [m].

    Particles that cannot reach `least` are given up. With `innovations` the answer tells them, with
    `by_theta` also their derivatives by d entries of theta, and with `steps` how the transitions
    settled. Tensors on the CPU.
    """
    from tpcd.belief.kernel import explain_range
    from tpcd.belief.kernel_given import Found, Given, Measured, SceneSlopes
    from tpcd.simulator.backends import solved_by

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
    normal, offset, friction, compliance = _alike(
        conditions.normal, conditions.offset_seen, conditions.friction, conditions.compliance
    )
    planes = (normal.flatten(0, 1), offset.flatten(0, 1))
    given = Given(
        *(
            value.contiguous().numpy()
            for value in _alike(conditions.target, conditions.stiffness, conditions.turn)
        ),
        HalfPlanes(*(value.contiguous().numpy() for value in planes)),
        *(value.contiguous().numpy() for value in (friction, compliance)),
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
        whitened,
        log_scale,
        slopes,
        *vars(settled).values(),
    )
    found = Found(*(value.numpy() for value in answers))
    points = points_ee.detach().double().mT.contiguous().numpy()
    soft = (conditions.compliance != 0).flatten(1).any(-1).expand(count)
    for yielding, group in ((0, ~soft), (terrains, soft)):
        law, which = law_of(settings, yielding), torch.nonzero(group).flatten().numpy()

        def run(tape: Tape, law: Law = law, which: np.ndarray = which) -> None:
            work = partial(
                explain_range, points, law, given, measured, by_theta, found, tape, which
            )
            in_parts(work, len(which), n)

        if len(which):
            device = points_ee.device
            solved_by(settings.solver, run, group.numpy(), len(law.room), terrains, device)
    answer = HistoryLikelihood(total, mean, covariance)
    if innovations:
        answer = replace(answer, whitened=whitened, log_scale=log_scale, slopes=slopes)
    if steps:
        answer = replace(answer, steps=settled)
    return answer


def _alike(*values: Tensor) -> list[Tensor]:
    """Values (m, r, ...) whose first two axes are made the same."""
    m, r = torch.broadcast_shapes(*(value.shape[:2] for value in values))
    return [value.expand(m, r, *value.shape[2:]) for value in values]
