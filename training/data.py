"""The data of a training: outlines in correspondence, latents in between, and batches.

`prepare` computes once what does not change during training; `Batches` serves random
batches of it. Lengths are in the networks' unit here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from tpcd.shape.deepsdf import UNIT
from training.config import TrainingConfig
from training.correspondence import correspond
from training.layout import make_layout
from training.mixture import Mixture
from training.outlines import data_hash, training_outlines
from training.polygons import Samples, sample_around

ANGLES = 64
"""Directions of one step in which support functions are compared."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """Everything the training reads, made from the configuration alone."""

    names: tuple[str, ...]
    vertices: tuple[np.ndarray, ...]
    """True outlines [m]."""
    data_hash: str
    codes: Float[Tensor, "n z"]
    """Initial codes."""
    weights: Float[Tensor, "m n"]
    """Latents in between are weights @ codes + offsets."""
    offsets: Float[Tensor, "m z"]
    mixture: Mixture | None
    """Density of the latents; None where it is uniform."""
    true: Float[Tensor, "n v 2"]
    """True outlines, filled up to the same number of vertices, in units of `UNIT`."""
    targets: Float[Tensor, "n p 2"]
    """Points that the decoder should give for the outlines."""
    morphs: Float[Tensor, "m p 2"]
    """Points that it should give in between."""
    samples: Samples
    """Points around the true outlines."""


def prepare(config: TrainingConfig) -> Prepared:
    """Load, resample and align the outlines, lay out the codes, measure distances."""
    rng = np.random.default_rng(config.optim.seed)
    generator = torch.Generator().manual_seed(config.optim.seed)
    outlines = training_outlines(config.data, rng)
    layout_config = config.layout
    vertices = list(outlines.values())
    aligned = correspond(
        vertices, layout_config.points, layout_config.rounding, layout_config.turning_share
    )
    layout = make_layout(aligned, config.network.latent_dim, layout_config, rng)
    spreads = (layout_config.near_spread / UNIT, layout_config.far_spread / UNIT)
    targets = _float(aligned / UNIT)
    true = _float(with_as_many_vertices(vertices) / UNIT)
    return Prepared(
        names=tuple(outlines),
        vertices=tuple(vertices),
        data_hash=data_hash(outlines),
        codes=_float(layout.codes),
        weights=_float(layout.weights),
        offsets=_float(layout.offsets),
        mixture=layout.mixture,
        true=true,
        targets=targets,
        morphs=_float(simple_morphs(layout.outline_weights, aligned) / UNIT),
        samples=sample_around(targets, true, layout_config.object_samples, spreads, generator),
    )


def simple_morphs(
    weights: Float64[np.ndarray, "m n"], outlines: Float64[np.ndarray, "n p 2"]
) -> Float64[np.ndarray, "m p 2"]:
    """Combinations of outlines that do not cross themselves.

    One that does moves towards the outline of its largest weight, by quarters of the way.
    """
    flat = outlines.reshape(len(outlines), -1)
    plain = (weights @ flat).reshape(-1, *outlines.shape[1:])
    nearest = outlines[weights.argmax(axis=1)]
    morphs = plain.copy()
    for share in (0.25, 0.5, 0.75, 1.0):
        crossed = ~shapely.is_valid(shapely.polygons(morphs))
        morphs[crossed] = plain[crossed] + share * (nearest[crossed] - plain[crossed])
    return morphs


def with_as_many_vertices(
    outlines: list[Float64[np.ndarray, "_ 2"]],
) -> Float64[np.ndarray, "n v 2"]:
    """The same polygons with as many vertices as the largest; missing ones go on the last edge."""
    most = max(len(vertices) for vertices in outlines)
    filled = []
    for vertices in outlines:
        share = np.linspace(0, 1, most - len(vertices) + 1, endpoint=False)[1:, None]
        last_edge = vertices[-1] + share * (vertices[0] - vertices[-1])
        filled.append(np.vstack((vertices, last_edge)))
    return np.stack(filled)


class Batch(NamedTuple):
    """Random draws of one step."""

    step: int
    """Which step of the training they are for, from 0."""
    outline: Int[Tensor, " s"]
    """Outlines of the distances."""
    sample: Int[Tensor, " s"]
    """Which of their samples."""
    between: Int[Tensor, " k"]
    """Latents in between."""
    angles: Float[Tensor, " a"]
    """Directions of the support functions [rad]."""


class Batches:
    """The random batches of a training from step `first` on, to the last of `optim.steps`.

    They follow from the configuration alone, so a resumed training sees what it would have seen.
    """

    def __init__(self, prepared: Prepared, config: TrainingConfig, first: int = 0) -> None:
        self.prepared, self.config, self.first = prepared, config, first

    def __len__(self) -> int:
        return self.config.optim.steps - self.first

    def __iter__(self) -> Iterator[Batch]:
        data, optim = self.prepared, self.config.optim
        generator = torch.Generator().manual_seed(optim.seed + 1)
        outlines, samples = data.samples.distance.shape
        for step in range(optim.steps):
            batch = Batch(
                step,
                torch.randint(outlines, (optim.batch,), generator=generator),
                torch.randint(samples, (optim.batch,), generator=generator),
                torch.randint(len(data.morphs), (optim.latents,), generator=generator),
                2 * torch.pi * torch.rand(ANGLES, generator=generator),
            )
            if step >= self.first:
                yield batch


def _float(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
