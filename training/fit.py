"""Best fit of a prior to an outline it has not seen, as an estimator could find it.

Unknown are the latent and, as in the estimation problem, a scale in [0.8, 1.2] and a mount
(20 mm, 0.2 rad) within which the outline may sit. Minimised is the mean distance from the
true outline to the decoded polygon plus the mean difference of the support functions (what
contact with flat surroundings feels), by Adam from several starts at once; only valid
latents count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
import torch
from jaxtyping import Float64
from torch import Tensor

from tpcd.planar import transform_points
from tpcd.shape.deepsdf import DeepSDFShape
from tpcd.shape.distance import polygon_distance
from training.evaluate import MM, support_of, uniform_points

STARTS, FIRST_STEPS = 32, 40
"""Latents that set out, and steps after which most of them give up. With four, the mean over
outlines was a third larger, and single errors up to four times as large."""
KEPT, LAST_STEPS = 8, 150
"""Latents that go on, and for how long."""
HULL_DIRECTIONS = 1440
"""Directions in which support functions are compared: 4.4 mrad apart."""
REACH = (0.2, 0.02, 0.02, 0.2)
"""Half-ranges of scale, mount x, mount z [m] and mount angle [rad]."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The best outline of a family for a true one."""

    latent: Tensor
    """Best latent (z)."""
    errors_mm: Float64[np.ndarray, " p"]
    """Distance of points along the true outline from the fitted polygon [mm]."""
    hull_errors_mm: Float64[np.ndarray, " k"]
    """Support function of the fit minus that of the outline in `HULL_DIRECTIONS` [mm]: the change
    of the gap that contact with a flat terrain feels."""
    hull_slopes_mm: Float64[np.ndarray, " k"]
    """Its derivative by the angle [mm]: how far contact is elsewhere along the terrain."""


def best_fit(
    shape: DeepSDFShape,
    vertices: Float64[np.ndarray, "_ 2"],
    generator: torch.Generator,
    scene: bool = True,
) -> Fit:
    """Fit latent and, with `scene`, scale and mount to an outline [m]."""
    true = torch.from_numpy(uniform_points(vertices, 160)).float()
    draws = torch.cat((shape.sample_latent(400, generator), shape.codes)).float()
    size = shape.boundary_points(draws).detach()
    extent = size.amax(1) - size.amin(1)
    wanted = torch.tensor(np.ptp(vertices, axis=0)).float()
    nearest = (extent - wanted).abs().sum(-1).topk(40, largest=False).indices
    outlines = size[nearest]
    rough = torch.cdist(true[None].expand(len(nearest), -1, -1), outlines).amin(-1).mean(-1)
    latent = draws[nearest[rough.topk(STARTS, largest=False).indices]]
    free = torch.zeros(STARTS, 4)
    angle = torch.linspace(0, 2 * torch.pi, 61)[:-1]
    around = torch.stack((angle.cos(), angle.sin()))
    true_support = (torch.tensor(vertices).float() @ around).amax(0)

    def loss_of(latent: Tensor, free: Tensor) -> Tensor:
        placed = _placed(shape, latent, free if scene else 0 * free)
        support = ((placed @ around).amax(-2) - true_support).abs().mean(-1)
        return polygon_distance(true.expand(len(placed), -1, -1), placed).abs().mean(-1) + support

    for count, steps in ((STARTS, FIRST_STEPS), (KEPT, LAST_STEPS)):
        latent, free, loss = _descend(shape, loss_of, latent[:count], free[:count], steps)
        order = loss.argsort()
        latent, free = latent[order], free[order]
    z, parameters = latent[0], free[0]
    placed = _placed(shape, z[None], parameters[None] if scene else torch.zeros(1, 4))[0]
    fitted = placed.double().numpy()
    distance = shapely.distance(
        shapely.LinearRing(fitted), shapely.points(uniform_points(vertices))
    )
    hull, slopes = support_of(fitted, HULL_DIRECTIONS) - support_of(vertices, HULL_DIRECTIONS)
    return Fit(z.double(), MM * distance, MM * hull, MM * slopes)


def _descend(
    shape: DeepSDFShape,
    loss_of: Callable[[Tensor, Tensor], Tensor],
    latent: Tensor,
    free: Tensor,
    steps: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """For each start the valid place of least loss on the way of so many steps of Adam, and that
    loss; infinite where the way has no valid place."""
    latent, free = latent.clone().requires_grad_(), free.clone().requires_grad_()
    optimizer = torch.optim.Adam([{"params": [latent], "lr": 0.03}, {"params": [free], "lr": 0.05}])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    best = torch.full((len(latent),), torch.inf)
    kept = (latent.detach().clone(), free.detach().clone())
    for _ in range(steps):
        loss = loss_of(latent, free)
        better = (loss.detach() < best) & shape.valid(latent.detach())
        best = torch.where(better, loss.detach(), best)
        for store, now in zip(kept, (latent, free), strict=True):
            store[better] = now.detach()[better]
        optimizer.zero_grad()
        loss.sum().backward()
        optimizer.step()
        schedule.step()
    return *kept, best


def _placed(shape: DeepSDFShape, latent: Tensor, free: Tensor) -> Tensor:
    """Decoded outlines scaled and mounted by bounded transforms of `free`."""
    scale, x, z, angle = (torch.tanh(free) * torch.tensor(REACH)).unbind(-1)
    points = (1 + scale)[:, None, None] * shape.boundary_points(latent)
    return transform_points(torch.stack((x, z, angle), dim=-1), points)
