"""Where a trained prior decodes to one plausible outline, and the density on that region.

Two dimensions: a mask over the square, found by decoding the nodes of a grid
and what lies between them. More dimensions: the fitted mixture, cut off at the lowest density at
which nearly all draws decode well. (A classifier of latents was tried instead of the floor: for
the same purity it gave up half of the draws, the floor less than a tenth.)
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.shape.deepsdf import UNIT, DeepSDFNetwork
from tpcd.shape.density import MaskDensity, MixtureDensity
from tpcd.shape.simple import one_outline
from training.mixture import Mixture
from training.watch import TrainingError

LEFT_OUT = 0.02
"""Least share of the mixture's draws that lie below the density floor."""
PRECISION = 0.998
"""Share of draws above the floor that must decode to one plausible outline."""
COMPONENT_TRIALS, COMPONENT_SHARE = 60, 0.97
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
    network: DeepSDFNetwork, latents: Float[Tensor, "count z"]
) -> Bool[np.ndarray, " count"]:
    """Whether each latent decodes to one closed outline, see `one_outline`."""
    good = []
    for some in latents.split(1000):
        with torch.no_grad():
            outlines = network.outline(some.to(network.codes.dtype)).double().cpu().numpy()
        good.append(one_outline(UNIT * outlines))
    return np.concatenate(good)


def fit_mask(network: DeepSDFNetwork, cells: int) -> MaskDensity:
    """Mark the cells of the square whose corners, middles of the edges and centre all decode
    well."""
    ticks = torch.linspace(-1, 1, 2 * cells + 1, dtype=torch.float64)
    good = decodes_well(network, torch.cartesian_prod(ticks, ticks))
    nodes = torch.from_numpy(good).reshape(len(ticks), -1)
    marked = nodes.unfold(0, 3, 2).unfold(1, 3, 2).flatten(2).all(-1)
    if not marked.any():
        raise TrainingError("no cell of latents decodes to closed outlines; train for more steps")
    return MaskDensity(marked)


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
    plausible = torch.from_numpy(decodes_well(network, latents))
    log_density = whole.raw_log_density(latents)
    order = log_density.argsort(descending=True)
    share = plausible[order].double().cumsum(0) / torch.arange(1, len(order) + 1)
    enough = (share >= PRECISION).nonzero()
    if not len(enough):
        raise TrainingError(
            "the densest latents do not decode to closed outlines; train for more steps"
        )
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

    Such a component sits on outlines with a neck too thin for the decoder (rolled rims of
    cups): the two sides of the neck cross.
    """
    count, z = mixture.means.shape
    noise = torch.randn(count, COMPONENT_TRIALS, z, 1, generator=generator, dtype=torch.float64)
    trials = mixture.means[:, None] + (mixture.factors[:, None] @ noise)[..., 0]
    good = decodes_well(network, trials.flatten(0, 1).clamp(-1, 1))
    keep = torch.from_numpy(good.reshape(count, -1).mean(1) >= COMPONENT_SHARE)
    if not keep.any():
        raise TrainingError("no component decodes to closed outlines; train for more steps")
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
    plausible = torch.from_numpy(decodes_well(network, trials))
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
