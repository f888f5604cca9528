"""Prior densities of a shape latent, each with the region where the latent is valid.

`MaskDensity` is uniform on the valid cells of [-1, 1]^2, as in the paper but without the
regions that decode to nothing plausible. `MixtureDensity` is a Gaussian mixture fitted to
the latents of plausible outlines, truncated to the box and to its own high-density region,
for latents with more dimensions, where a uniform box would be nearly empty of outlines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@runtime_checkable
class LatentDensity(Protocol):
    """A normalised density on the valid part of [-1, 1]^z."""

    def valid(self, latent: Float[Tensor, "*batch z"]) -> Bool[Tensor, "*batch"]:
        """Whether the density is positive here."""
        ...

    def log_density(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch"]:
        """Log density, normalised on the valid region; -inf elsewhere."""
        ...

    def curvature(
        self, latent: Float[Tensor, "*batch z"]
    ) -> tuple[Float[Tensor, "*batch z"], Float[Tensor, "*batch z z"]]:
        """Gradient of the log density within the valid region, and a precision, positive
        semi-definite, that bounds its curvature."""
        ...

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "count z"]:
        """Independent draws, float64 on the CPU."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint stores of the density."""
        ...


@dataclass(frozen=True, eq=False)
class MaskDensity:
    """Uniform on the cells of a square grid over [-1, 1]^2 that are marked valid."""

    cells: Bool[Tensor, "n n"]
    """cells[i, j] covers z_0 in [-1 + 2i/n, -1 + 2(i+1)/n] and z_1 likewise with j."""

    def valid(self, latent: Float[Tensor, "*batch z"]) -> Bool[Tensor, "*batch"]:
        """Whether the latent lies in a valid cell; NaN and outside the box are not valid."""
        n = self.cells.shape[0]
        inside = (latent.abs() <= 1).all(-1)
        safe = torch.where(inside[..., None], latent, torch.zeros_like(latent))
        index = ((safe + 1) * (n / 2)).long().clamp(0, n - 1)
        return self.cells.to(latent.device)[index[..., 0], index[..., 1]] & inside

    def log_density(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch"]:
        """-log(valid area) in valid cells, -inf elsewhere."""
        area = 4.0 * self.cells.double().mean().item()
        level = torch.full_like(latent[..., 0], -math.log(area))
        return torch.where(self.valid(latent), level, torch.full_like(level, -torch.inf))

    def curvature(
        self, latent: Float[Tensor, "*batch z"]
    ) -> tuple[Float[Tensor, "*batch z"], Float[Tensor, "*batch z z"]]:
        """Zero gradient and precision: the density is flat where it is positive."""
        z = latent.shape[-1]
        return torch.zeros_like(latent), latent.new_zeros(*latent.shape, z)

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "count z"]:
        """Uniform draws: a valid cell, then a place within it."""
        where = self.cells.cpu().nonzero()
        cell = torch.randint(len(where), (count,), generator=generator)
        within = torch.rand(count, 2, generator=generator, dtype=torch.float64)
        # A draw of exactly 1 - eps may round up across the cell's edge; stay inside.
        within = within.clamp(1e-9, 1 - 1e-9)
        return (where[cell] + within) * (2 / self.cells.shape[0]) - 1

    def tensors(self) -> dict[str, Tensor]:
        """The mask as bytes."""
        return {"cells": self.cells.to(torch.uint8)}

    @staticmethod
    def from_tensors(tensors: dict[str, Tensor]) -> MaskDensity:
        """Inverse of `tensors`; ValueError where they are no mask."""
        cells = tensors["cells"]
        if cells.ndim != 2 or cells.shape[0] != cells.shape[1]:
            raise ValueError(f"'cells' of shape {tuple(cells.shape)}, expected a square")
        if not ((cells == 0) | (cells == 1)).all() or not cells.any():
            raise ValueError("'cells', expected 0 and 1, and one of them 1")
        return MaskDensity(cells.bool())


@dataclass(frozen=True, eq=False)
class MixtureDensity:
    """Gaussian mixture cut off at the box and at a density level, then normalised."""

    weights: Float[Tensor, " k"]
    """Component weights, summing to 1."""
    means: Float[Tensor, "k z"]
    """Component means."""
    factors: Float[Tensor, "k z z"]
    """Lower Cholesky factors of the component covariances."""
    floor: float
    """Log of the untruncated density below which a latent is not valid."""
    kept: float
    """Probability that a draw of the untruncated mixture is valid (normalisation)."""

    def raw_log_density(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch"]:
        """Log density of the untruncated mixture."""
        parts, _, _ = self._parts(latent)
        return torch.logsumexp(parts, dim=-1).reshape(latent.shape[:-1]).to(latent.dtype)

    def curvature(
        self, latent: Float[Tensor, "*batch z"]
    ) -> tuple[Float[Tensor, "*batch z"], Float[Tensor, "*batch z z"]]:
        """Gradient of the log density, and the mean of the components' precisions by the share
        that each has in the density here. The curvature is that less the spread of the
        components' gradients."""
        z = latent.shape[-1]
        parts, precision, linear = self._parts(latent)
        share = parts.softmax(-1)
        mean = (share @ precision.flatten(1)).unflatten(-1, (z, z))
        gradient = share @ linear - (mean @ latent.reshape(-1, z, 1).double())[..., 0]
        mean = mean.reshape(*latent.shape, z).to(latent.dtype)
        return gradient.reshape(latent.shape).to(latent.dtype), mean

    def _parts(self, latent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log density (m, k) of each weighted component at the flattened latents, and the
        components' precisions P and P m."""
        # (x - m)' P (x - m) = x' P x - 2 m' P x + m' P m for all components by two matrix
        # products with x x' and x, in double precision as the terms cancel.
        flat = latent.reshape(-1, latent.shape[-1]).double()
        log_scale, linear, precision = (form.to(latent.device) for form in self._forms)
        products = (flat[:, :, None] * flat[:, None, :]).flatten(1)
        parts = log_scale + flat @ linear.mT - 0.5 * products @ precision.flatten(1).mT
        return parts, precision, linear

    @cached_property
    def _forms(self) -> tuple[Tensor, Tensor, Tensor]:
        """Log density (k) of each weighted component at zero, P m (k, z) and P (k, z, z)."""
        means, factors = self.means, self.factors
        # They are kept, and what is made in inference mode could not be differentiated by later.
        with torch.inference_mode(False):
            precision = torch.cholesky_inverse(factors)
            linear = (precision @ means[..., None])[..., 0]
            log_scale = (
                self.weights.log()
                - factors.diagonal(dim1=-2, dim2=-1).log().sum(-1)
                - 0.5 * (means.shape[-1] * math.log(2 * math.pi) + (linear * means).sum(-1))
            )
        return log_scale, linear, precision

    def valid(self, latent: Float[Tensor, "*batch z"]) -> Bool[Tensor, "*batch"]:
        """Whether the latent lies in the box and above the density floor."""
        # Where one component alone is above it the sum is, and need not be taken.
        parts, _, _ = self._parts(latent)
        raw = parts.amax(-1)
        low = torch.nonzero(~(raw >= self.floor)).flatten()
        raw = raw.index_copy(0, low, torch.logsumexp(parts[low], dim=-1))
        return self._valid(latent, raw.reshape(latent.shape[:-1]).to(latent.dtype))

    def log_density(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch"]:
        """Log density normalised on the valid region, -inf elsewhere."""
        raw = self.raw_log_density(latent)
        return torch.where(
            self._valid(latent, raw), raw - math.log(self.kept), torch.full_like(raw, -torch.inf)
        )

    def _valid(self, latent: Tensor, raw: Tensor) -> Tensor:
        return (latent.abs() <= 1).all(-1) & (raw >= self.floor)

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "count z"]:
        """Draws by rejection from the untruncated mixture."""
        kept: list[Tensor] = []
        missing = count
        while missing > 0:
            draws = self.raw_sample(int(missing / self.kept * 1.2) + 16, generator)
            kept.append(draws[self.valid(draws)][:missing])
            missing -= len(kept[-1])
        return torch.cat(kept) if kept else torch.zeros(0, self.means.shape[-1]).double()

    def raw_sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "count z"]:
        """Draws of the untruncated mixture, float64 on the CPU."""
        weights, means = self.weights.double().cpu(), self.means.double().cpu()
        pick = torch.multinomial(weights, count, replacement=True, generator=generator)
        noise = torch.randn(count, means.shape[-1], 1, generator=generator, dtype=torch.float64)
        return means[pick] + (self.factors.double().cpu()[pick] @ noise)[..., 0]

    def tensors(self) -> dict[str, Tensor]:
        """Mixture and truncation, float64."""
        return {
            "weights": self.weights.double(),
            "means": self.means.double(),
            "factors": self.factors.double(),
            "truncation": torch.tensor([self.floor, self.kept], dtype=torch.float64),
        }

    @staticmethod
    def from_tensors(tensors: dict[str, Tensor]) -> MixtureDensity:
        """Inverse of `tensors`; ValueError where they are no truncated mixture."""
        weights, means, factors = (tensors[name] for name in ("weights", "means", "factors"))
        shapes = tuple(weights.shape), tuple(means.shape), tuple(factors.shape)
        k, z = (len(weights), means.shape[-1]) if weights.ndim and means.ndim else (0, 0)
        if k == 0 or z == 0 or shapes != ((k,), (k, z), (k, z, z)):
            raise ValueError(f"weights, means and factors of shapes {shapes}")
        if not (weights > 0).all() or abs(float(weights.sum()) - 1) > 1e-6:
            raise ValueError("'weights', expected positive numbers that sum to 1")
        if not (factors.diagonal(dim1=-2, dim2=-1) > 0).all() or (factors.triu(1) != 0).any():
            raise ValueError("'factors', expected lower triangles with a positive diagonal")
        if tensors["truncation"].shape != (2,):
            raise ValueError(f"'truncation' of {tensors['truncation'].numel()} numbers, expected 2")
        floor, kept = tensors["truncation"].tolist()
        if not 0 < kept <= 1:
            raise ValueError(f"'truncation' that keeps {kept:g} of the mixture")
        return MixtureDensity(weights, means, factors, floor, kept)
