"""A learned family of outlines: a DeepSDF with an outline head.

Two plain multilayer perceptrons share one latent z in [-1, 1]^z. The signed distance
f(p; z) (Park et al., "DeepSDF", CVPR 2019, arXiv 1901.05103, section 3; sine activations
after Sitzmann et al., arXiv 2006.09661) defines the outline as its zero level set. The head
g(z) gives p points that lie on that level set, in order and counter-clockwise, dense where
the outline bends; it is trained together with f and costs 1/100 of finding them by search.
Inside the networks lengths are in units of `UNIT`; at the door they are metres.
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
from tpcd.shape.protocol import Misfit

UNIT = 0.1
"""Length that the networks see as 1 [m]."""


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
    """Sizes of the two networks."""

    latent_dim: int
    """Size z of the latent."""
    sdf_width: int = 128
    """Units of each hidden layer of the signed distance."""
    sdf_depth: int = 4
    """Hidden layers of the signed distance."""
    head_width: int = 128
    """Units of each hidden layer of the outline head."""
    head_depth: int = 3
    """Hidden layers of the outline head."""
    points: int = 128
    """Outline points p that the head gives."""
    disc_radius: float = 0.0
    """If positive, f is the distance to a disc of this radius [m] plus what the network
    adds: right far away before any training, so that no stray level sets appear there."""


class DeepSDFNetwork(nn.Module):
    """Weights of f and g and the codes of the training outlines; lengths in `UNIT`."""

    def __init__(self, architecture: Architecture, codes: int) -> None:
        super().__init__()
        a = architecture
        self.architecture = a
        self.sdf = sine_mlp(2 + a.latent_dim, a.sdf_width, a.sdf_depth, 1)
        self.head = sine_mlp(a.latent_dim, a.head_width, a.head_depth, 2 * a.points)
        self.codes = nn.Parameter(torch.zeros(codes, a.latent_dim))

    def distance(
        self, points: Float[Tensor, "*batch p 2"], latent: Float[Tensor, "*batch z"]
    ) -> Float[Tensor, "*batch p"]:
        """Signed distance f(p; z), all in units of `UNIT`."""
        # The first layer acts on (p, z) = W_p p + W_z z; the latent's part is the same for
        # all points of one latent, so it is computed once for each latent.
        first = self.sdf[0]
        from_points = points @ first.weight[:, :2].mT
        from_latent = latent @ first.weight[:, 2:].mT + first.bias
        learned = self.sdf[1:](from_points + from_latent[..., None, :])[..., 0]
        if self.architecture.disc_radius <= 0:
            return learned
        # The root is softened by 5 mm: the distance to a point has a kink there.
        radius = (points.square().sum(-1) + (0.005 / UNIT) ** 2).sqrt()
        return radius - self.architecture.disc_radius / UNIT + learned

    def outline(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch p 2"]:
        """Outline points g(z) in units of `UNIT`."""
        return self.head(latent).unflatten(-1, (self.architecture.points, 2))


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
        """Signed distance f to the outline [m], positive outside the object."""
        network = self._on(latent.device)
        dtype = network.codes.dtype
        distance = network.distance(points_object.to(dtype) / UNIT, latent.to(dtype))
        return (distance * UNIT).to(latent.dtype)

    def boundary_points(
        self, latent: Float[Tensor, "*batch z"], projections: int = 0
    ) -> Float[Tensor, "*batch p 2"]:
        """Outline points of the head [m], counter-clockwise, dense where the outline bends.

        `projections` Newton steps p - f grad f / |grad f|^2 bring them closer to the zero
        level set of f, at the cost of one evaluation of f with its gradient each.
        """
        network = self._on(latent.device)
        z = latent.to(network.codes.dtype)
        points = network.outline(z)
        for _ in range(projections):
            points = project(network, points, z)
        return (points * UNIT).to(latent.dtype)

    def valid(self, latent: Float[Tensor, "*batch z"]) -> Bool[Tensor, "*batch"]:
        """Whether the latent decodes to exactly one closed outline of plausible size."""
        return self.density.valid(latent)

    def log_density(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch"]:
        """Log of the normalised prior density of the latent; -inf where not valid."""
        return self.density.log_density(latent)

    def latent_curvature(
        self, latent: Float[Tensor, "*batch z"]
    ) -> tuple[Float[Tensor, "*batch z"], Float[Tensor, "*batch z z"]]:
        """Gradient of the log density within the valid region, and a precision, positive
        semi-definite, that bounds its curvature."""
        return self.density.curvature(latent)

    def sample_latent(self, count: int, generator: torch.Generator) -> Float[Tensor, "count z"]:
        """Draw valid latents from the prior, float64 on the CPU."""
        return self.density.sample(count, generator)

    def _on(self, device: torch.device) -> DeepSDFNetwork:
        """The network on the latent's device, copied there once."""
        here = self.network.codes.device
        if device == here:
            return self.network
        key = (device, self.network.codes.dtype)
        if key not in self._copies:
            self._copies[key] = copy.deepcopy(self.network).to(device)
        return self._copies[key]


def project(
    network: DeepSDFNetwork, points: Float[Tensor, "*batch p 2"], latent: Float[Tensor, "*batch z"]
) -> Float[Tensor, "*batch p 2"]:
    """One Newton step of points towards the zero level set of f, in units of `UNIT`.

    The result is differentiable with respect to points and latent: autograd is on inside
    whenever the caller asks for gradients, and the direction grad f is held constant, which
    is exact on the level set (there f = 0, so the derivative of grad f / |grad f|^2 drops).
    """
    with torch.enable_grad():
        at = points.detach().requires_grad_()
        gradient = torch.autograd.grad(network.distance(at, latent.detach()).sum(), at)[0]
    direction = gradient / gradient.square().sum(-1, keepdim=True).clamp_min(0.04)
    step = network.distance(points, latent)[..., None] * direction
    # A step longer than 5 mm means that the point is not near this level set; leave it.
    length = step.detach().norm(dim=-1, keepdim=True)
    return points - torch.where(length < 0.005 / UNIT, step, torch.zeros_like(step))
