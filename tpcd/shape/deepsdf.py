"""A learned family of outlines: a DeepSDF whose level sets are polygons.

One plain multilayer perceptron with sine activations (Sitzmann et al., arXiv 2006.09661)
decodes a latent z in [-1, 1]^z to p outline points, in order and counter-clockwise, dense where
the outline bends. The signed distance f(p; z) of the family (Park et al., "DeepSDF", CVPR 2019,
arXiv 1901.05103, section 3: learned codes, an auto-decoder) is the exact distance to that
polygon. So its zero level set is the polygon that the simulator touches, its gradient has norm
one, and it has no stray level sets far away, none of which holds of a network that takes points.
Inside the network lengths are in units of `UNIT`; at the door they are metres.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from tpcd.shape.density import LatentDensity
from tpcd.shape.distance import polygon_distance
from tpcd.shape.protocol import Misfit
from tpcd.shape.simple import one_outline

UNIT = 0.1
"""Length that the networks see as 1 [m]."""
LARGEST = {"latent_dim": 1024, "width": 16_384, "depth": 64, "points": 4096}
"""Sizes of a decoder beyond these are a slip."""
_ROUNDS = 100
"""Rounds at most in which latents that are not valid are drawn anew."""


class Sine(nn.Module):
    """The activation sin(x)."""

    def forward(self, x: Tensor) -> Tensor:
        """Return sin(x) of any shape."""
        return torch.sin(x)


def sine_mlp(inputs: int, width: int, depth: int, outputs: int) -> nn.Sequential:
    """Linear layers with sine activations between them: `depth` hidden layers of `width`."""
    sizes = [inputs, *([width] * depth)]
    layers: list[nn.Module] = []
    for incoming, outgoing in zip(sizes[:-1], sizes[1:], strict=True):
        layers += [nn.Linear(incoming, outgoing), Sine()]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


@dataclass(frozen=True)
class Architecture:
    """Sizes of the decoder."""

    latent_dim: int
    """Size z of the latent."""
    width: int = 256
    """Units of each hidden layer."""
    depth: int = 3
    """Hidden layers."""
    points: int = 128
    """Outline points p."""

    def __post_init__(self) -> None:
        """Refuse what is no size."""
        for name, size in vars(self).items():
            if not 1 <= size <= LARGEST[name]:
                raise ValueError(f"{name} is {size}, expected 1 to {LARGEST[name]}")


class DeepSDFNetwork(nn.Module):
    """Weights of the decoder and the codes of the training outlines; lengths in `UNIT`."""

    def __init__(self, architecture: Architecture, codes: int) -> None:
        super().__init__()
        a = architecture
        self.architecture = a
        self.decoder = sine_mlp(a.latent_dim, a.width, a.depth, 2 * a.points)
        self.codes = nn.Parameter(torch.zeros(codes, a.latent_dim))

    def outline(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch p 2"]:
        """Outline points in units of `UNIT`."""
        return self.decoder(latent).unflatten(-1, (self.architecture.points, 2))

    def distance(
        self, points: Float[Tensor, "*batch s 2"], latent: Float[Tensor, "*batch z"]
    ) -> Float[Tensor, "*batch s"]:
        """Signed distance f(points; z) to the outline, all in units of `UNIT`."""
        shape = torch.broadcast_shapes(points.shape[:-2], latent.shape[:-1])
        polygons = self.outline(latent).expand(*shape, -1, -1)
        s, p = points.shape[-2], self.architecture.points
        together = points.expand(*shape, -1, -1).reshape(-1, s, 2)
        return polygon_distance(together, polygons.reshape(-1, p, 2)).reshape(*shape, s)


@dataclass(frozen=True, eq=False)
class DeepSDFShape:
    """The trained family as the rest of the library sees it (`protocol.Shape`).

    Evaluation runs in the precision of the weights (float32 unless moved by `to`); what
    comes out has the latent's dtype and device.
    """

    network: DeepSDFNetwork
    density: LatentDensity
    """Prior density of the latent and the region where it is valid."""
    names: tuple[str, ...] = ()
    """Names of the training outlines, in the order of `codes`."""
    misfit: Misfit = Misfit()
    """How outlines differ from their best fits."""
    card: Mapping[str, Any] = field(default_factory=dict)
    """The checkpoint's card: configuration, errors, provenance."""
    _copies: dict[tuple[torch.device, torch.dtype], DeepSDFNetwork] = field(
        default_factory=dict, repr=False
    )

    @property
    def latent_dim(self) -> int:
        """Size z of the latent."""
        return self.network.architecture.latent_dim

    @property
    def codes(self) -> Float[Tensor, "n z"]:
        """Latents of the training outlines, float64."""
        return self.network.codes.detach().double()

    def code_of(self, name: str) -> Float[Tensor, " z"]:
        """Latent of one training outline, float64; KeyError names those that exist."""
        if name not in self.names:
            raise KeyError(f"no training outline '{name}'; there are {', '.join(self.names)}")
        return self.codes[self.names.index(name)]

    def to(self, dtype: torch.dtype) -> DeepSDFShape:
        """The same family evaluated in another precision, for example for gradient checks."""
        return replace(self, network=copy.deepcopy(self.network).to(dtype), _copies={})

    def signed_distance(
        self, points_object: Float[Tensor, "*batch p 2"], latent: Float[Tensor, "*batch z"]
    ) -> Float[Tensor, "*batch p"]:
        """Signed distance to the outline of the latent [m], positive outside the object; exact,
        with a gradient of norm one, see `polygon_distance`."""
        network = self._on(latent.device)
        dtype = network.codes.dtype
        distance = network.distance(points_object.to(dtype) / UNIT, latent.to(dtype))
        return (distance * UNIT).to(latent.dtype)

    def boundary_points(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch p 2"]:
        """Outline points [m], counter-clockwise, dense where the outline bends."""
        network = self._on(latent.device)
        return (network.outline(latent.to(network.codes.dtype)) * UNIT).to(latent.dtype)

    def valid(self, latent: Float[Tensor, "*batch z"]) -> Bool[Tensor, "*batch"]:
        """Whether the latent decodes to exactly one closed outline of plausible size, and lies
        where the density is positive."""
        valid = self.density.valid(latent)
        with torch.no_grad():
            outlines = self.boundary_points(latent[valid]).double().cpu().numpy()
        valid[valid.clone()] = torch.from_numpy(one_outline(outlines)).to(valid.device)
        return valid

    def log_density(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch"]:
        """Log of the prior density of the latent; -inf outside of the region that it is cut off at,
        in which a few latents of a thousand are not valid."""
        return self.density.log_density(latent)

    def latent_curvature(
        self, latent: Float[Tensor, "*batch z"]
    ) -> tuple[Float[Tensor, "*batch z"], Float[Tensor, "*batch z z"]]:
        """Gradient of the log density within the valid region, and a precision, positive
        semi-definite, that bounds its curvature."""
        return self.density.curvature(latent)

    def sample_latent(
        self, count: int, generator: torch.Generator, checked: bool = True
    ) -> Float[Tensor, "count z"]:
        """Draw valid latents from the prior, float64 on the CPU; without the check a few of a
        thousand are not valid. Raises ValueError where hardly any is."""
        draws = self.density.sample(count, generator)
        for _ in range(_ROUNDS if checked else 0):
            kept = draws[self.valid(draws)]
            missing = count - len(kept)
            if missing == 0:
                return kept
            draws = torch.cat((kept, self.density.sample(missing, generator)))
        if not checked:
            return draws
        raise ValueError(
            f"after {_ROUNDS} rounds of drawing anew, {missing} of {count} latents still decode to "
            "no closed outline; train this prior for more steps"
        )

    def _on(self, device: torch.device) -> DeepSDFNetwork:
        """The network on the latent's device, copied there once."""
        here = self.network.codes.device
        if device == here:
            return self.network
        key = (device, self.network.codes.dtype)
        if key not in self._copies:
            self._copies[key] = copy.deepcopy(self.network).to(device)
        return self._copies[key]
