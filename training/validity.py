"""Where a trained prior decodes to one plausible outline, and the density on that region.

Two dimensions: a mask over the square, found by decoding every node of a grid. More
dimensions: the fitted mixture, cut off at the lowest density at which nearly all draws
decode to one closed outline. (A classifier of latents was tried instead of the floor: for
the same purity it gave up half of the draws, the floor less than a tenth.)
"""

from __future__ import annotations

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from tpcd.errors import TpcdError
from tpcd.shape.deepsdf import DeepSDFNetwork, DeepSDFShape
from tpcd.shape.density import MaskDensity, MixtureDensity
from tpcd.shape.levelset import decodes_plausibly
from training.mixture import Mixture


class TrainingError(TpcdError):
    """A training that led to no usable prior."""


FARTHEST_HEAD = 0.005
"""A latent is not valid where the head strays from the level set by more than this [m]."""
FARTHEST_FROM_CODES = 0.002
"""Nor, away from the codes, by more than this [m] (two dimensions)."""
LARGEST_KNOT = 0.03
"""Nor where the head's polygon crosses itself and loses more than this share of its area."""
LEFT_OUT = 0.02
"""Least share of the mixture's draws that lie below the density floor."""
PRECISION = 0.998
"""Share of draws above the floor that must decode to one plausible outline."""
COMPONENT_TRIALS, COMPONENT_SHARE = 60, 0.9
"""Draws of each component that are decoded, and how many of them must be plausible."""
LONELY = 0.15
"""Codes whose density is below this quantile of the draws get a component of their own."""
LONELY_SHARE = 0.06
"""Probability of these components together."""
LONELY_SPREAD = 0.05
"""Their standard deviation, as a share of that of all codes."""
LONELY_TRIALS = 12
"""Draws that must all decode for a lonely code to get its component."""


def decodes_well(
    shape: DeepSDFShape, latents: Float[Tensor, "count z"], spacing: float = 0.004
) -> Bool[np.ndarray, " count"]:
    """One closed outline of plausible size, and the head lies on it."""
    good = head_is_sound(shape, latents)
    candidates = latents[torch.from_numpy(good)]
    good[good] = decodes_plausibly(shape, candidates, spacing)
    return good


def head_is_sound(
    shape: DeepSDFShape, latents: Float[Tensor, "count z"]
) -> Bool[np.ndarray, " count"]:
    """The head's points lie near f = 0, and where they cross, only a small knot is lost.

    Knots of a fraction of a millimetre come with points that crowd at a concave corner; they
    change neither the outline nor its support.
    """
    sound = []
    for some in latents.split(500):
        good = (_straying(shape, some) < FARTHEST_HEAD).numpy()
        polygons = shapely.polygons(shape.boundary_points(some).detach().double().numpy())
        crossed = good & ~shapely.is_valid(polygons)
        good[crossed] = [_knot_share(polygon) < LARGEST_KNOT for polygon in polygons[crossed]]
        sound.append(good)
    return np.concatenate(sound)


def _straying(shape: DeepSDFShape, latents: Float[Tensor, "count z"]) -> Float[Tensor, " count"]:
    """Largest |f| at the head's points [m]."""
    with torch.no_grad():
        return torch.cat(
            [
                shape.signed_distance(shape.boundary_points(some), some).abs().amax(-1)
                for some in latents.split(500)
            ]
        )


def _knot_share(polygon: shapely.Polygon) -> float:
    """Share of the area that does not belong to the largest loop of a crossing polygon."""
    parts = shapely.get_parts(shapely.make_valid(polygon))
    areas = [piece.area for part in parts for piece in shapely.get_parts(part)]
    return 1.0 - max(areas) / sum(areas) if sum(areas) > 0 else 1.0


def fit_mask(network: DeepSDFNetwork, cells: int) -> MaskDensity:
    """Mark the cells of the square whose four corners all decode well.

    Away from the codes the head must also stray by less than `FARTHEST_FROM_CODES` at the
    corners, the middles of the edges and the centre; at the codes that would cut off training
    outlines with thin parts, where the head strays next to them.
    """
    everywhere = MaskDensity(torch.ones(1, 1, dtype=torch.bool))
    shape = DeepSDFShape(network, everywhere)
    ticks = torch.linspace(-1, 1, 2 * cells + 1, dtype=torch.float64)
    nodes = torch.cartesian_prod(ticks[::2], ticks[::2])
    good = torch.from_numpy(decodes_well(shape, nodes)).reshape(cells + 1, cells + 1)
    if not good.any():
        raise TrainingError("no latent decodes to one closed outline; train for more steps")
    corners = good[1:, 1:] & good[:-1, 1:] & good[1:, :-1] & good[:-1, :-1]
    straying = _straying(shape, torch.cartesian_prod(ticks, ticks))
    farthest = nn.functional.max_pool2d(straying.reshape(1, 1, len(ticks), -1), 3, 2)[0, 0]
    centres = (ticks[1::2, None].expand(-1, cells), ticks[1::2].expand(cells, -1))
    apart = torch.stack(centres, dim=-1)[..., None, :] - network.codes.detach()
    at_codes = (apart.abs().amax(-1) <= 3 / cells).any(-1)
    return MaskDensity(corners & ((farthest < FARTHEST_FROM_CODES) | at_codes))


def fit_truncated_mixture(
    network: DeepSDFNetwork, mixture: Mixture, seed: int, draws: int
) -> MixtureDensity:
    """Add components at lonely codes, then cut the mixture off where it decodes badly.

    `draws` of the mixture are decoded; the floor is the lowest density above which
    `PRECISION` of them are plausible.
    """
    generator = torch.Generator().manual_seed(seed + 10)
    parts = tuple(
        torch.from_numpy(part) for part in (mixture.weights, mixture.means, mixture.factors)
    )
    whole = MixtureDensity(*parts, floor=-np.inf, kept=1.0)
    whole = without_bad_components(network, whole, generator)
    whole = with_lonely_codes(network, whole, generator)
    latents = whole.raw_sample(draws, generator)
    latents = latents[(latents.abs() <= 1).all(-1)]
    shape = DeepSDFShape(network, whole)
    plausible = torch.from_numpy(decodes_plausibly(shape, latents))
    log_density = whole.raw_log_density(latents)
    order = log_density.argsort(descending=True)
    share = plausible[order].double().cumsum(0) / torch.arange(1, len(order) + 1)
    enough = (share >= PRECISION).nonzero()
    if not len(enough):
        raise TrainingError("the densest latents do not decode to closed outlines; train longer")
    floor = float(log_density[order[enough[-1, 0]]])
    many = whole.raw_sample(200_000, generator)
    density_of_many = whole.raw_log_density(many)
    floor = max(floor, float(density_of_many[:50_000].quantile(LEFT_OUT)))
    kept = float(((many.abs() <= 1).all(-1) & (density_of_many >= floor)).double().mean())
    return MixtureDensity(whole.weights, whole.means, whole.factors, floor, kept)


def without_bad_components(
    network: DeepSDFNetwork, mixture: MixtureDensity, generator: torch.Generator
) -> MixtureDensity:
    """The mixture without components of which too many draws fail to decode.

    Such a component sits on outlines with a neck too thin for the networks (rolled rims of
    cups): each draw then comes with a separate speck.
    """
    count, z = mixture.means.shape
    noise = torch.randn(count, COMPONENT_TRIALS, z, 1, generator=generator, dtype=torch.float64)
    trials = mixture.means[:, None] + (mixture.factors[:, None] @ noise)[..., 0]
    shape = DeepSDFShape(network, mixture)
    good = decodes_plausibly(shape, trials.flatten(0, 1).clamp(-1, 1))
    keep = torch.from_numpy(good.reshape(count, -1).mean(1) >= COMPONENT_SHARE)
    if not keep.any():
        raise TrainingError("no component decodes to closed outlines; train longer")
    weights = mixture.weights[keep] / mixture.weights[keep].sum()
    return MixtureDensity(weights, mixture.means[keep], mixture.factors[keep], -np.inf, 1.0)


def with_lonely_codes(
    network: DeepSDFNetwork, mixture: MixtureDensity, generator: torch.Generator
) -> MixtureDensity:
    """The mixture with a narrow component at each code that it gives little density."""
    codes = network.codes.detach().double()
    usual = mixture.raw_log_density(mixture.raw_sample(20_000, generator)).quantile(LONELY)
    lonely = codes[mixture.raw_log_density(codes) < usual]
    spread = LONELY_SPREAD * codes.std(0)
    noise = torch.randn(
        len(lonely), LONELY_TRIALS, codes.shape[1], generator=generator, dtype=torch.float64
    )
    trials = (lonely[:, None] + spread * noise).flatten(0, 1)
    plausible = torch.from_numpy(decodes_plausibly(DeepSDFShape(network, mixture), trials))
    lonely = lonely[plausible.reshape(-1, LONELY_TRIALS).all(1)]
    if not len(lonely):
        return mixture
    count = len(lonely)
    narrow = torch.diag(spread).expand(count, -1, -1)
    own = torch.full((count,), LONELY_SHARE / count, dtype=torch.float64)
    return MixtureDensity(
        weights=torch.cat(((1 - LONELY_SHARE) * mixture.weights, own)),
        means=torch.cat((mixture.means, lonely)),
        factors=torch.cat((mixture.factors, narrow)),
        floor=mixture.floor,
        kept=mixture.kept,
    )
