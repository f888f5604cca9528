"""Lightning's data side: outlines in correspondence, latents in between, and batches.

`prepare` computes once what does not change during training; `PriorData` serves random
batches of it. Lengths are in the networks' unit here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float, Int
from lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from tpcd.shape.deepsdf import UNIT
from tpcd.shape.levelset import HALF_WIDTH
from training.config import TrainingConfig
from training.correspondence import correspond
from training.layout import make_layout
from training.mixture import Mixture
from training.outlines import data_hash, training_outlines
from training.polygons import Samples, sample_around


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
    targets: Float[Tensor, "n p 2"]
    """Head targets of the outlines, in units of `UNIT`."""
    morphs: Float[Tensor, "m p 2"]
    """Head targets in between."""
    simple: Bool[Tensor, " m"]
    """Whether a morph does not cross itself; the others teach nothing."""
    object_samples: Samples
    between_samples: Samples


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
    targets = _float(aligned / UNIT)
    morphs = torch.einsum("mn,npc->mpc", _float(layout.outline_weights), targets)
    simple = torch.from_numpy(shapely.is_valid(shapely.polygons(morphs.numpy())))
    spreads = (layout_config.near_spread / UNIT, layout_config.far_spread / UNIT)
    half_width = HALF_WIDTH / UNIT
    true = _float(_same_count(vertices) / UNIT)
    return Prepared(
        names=tuple(outlines),
        vertices=tuple(vertices),
        data_hash=data_hash(outlines),
        codes=_float(layout.codes),
        weights=_float(layout.weights),
        offsets=_float(layout.offsets),
        mixture=layout.mixture,
        targets=targets,
        morphs=morphs,
        simple=simple,
        object_samples=sample_around(
            targets, true, layout_config.object_samples, spreads, half_width, generator
        ),
        between_samples=sample_around(
            morphs, morphs, layout_config.between_samples, spreads, half_width, generator
        ),
    )


class Batch(NamedTuple):
    """Random indices of one step."""

    outline: Int[Tensor, " s"]
    outline_sample: Int[Tensor, " s"]
    between: Int[Tensor, " s"]
    between_sample: Int[Tensor, " s"]
    head: Int[Tensor, " h"]
    consistency: Int[Tensor, " c"]
    consistency_outline: Int[Tensor, " c"]
    consistency_start: Int[Tensor, " 1"]


class _Draws(IterableDataset):
    """Batches of random indices, from a step on, so that a resumed run sees the same ones."""

    def __init__(self, prepared: Prepared, config: TrainingConfig) -> None:
        self.prepared, self.config = prepared, config

    def __len__(self) -> int:
        return self.config.optim.steps

    def __iter__(self) -> Iterator[Batch]:
        data, optim = self.prepared, self.config.optim
        generator = torch.Generator().manual_seed(optim.seed + 1)
        between = int(optim.between_share * optim.batch)
        own = optim.batch - between
        outlines, per_outline = data.object_samples.distance.shape
        latents, per_latent = data.between_samples.distance.shape

        def draw(high: int, count: int) -> Tensor:
            return torch.randint(high, (count,), generator=generator)

        for _ in range(len(self)):
            yield Batch(
                draw(outlines, own),
                draw(per_outline, own),
                draw(latents, between),
                draw(per_latent, between),
                draw(latents, optim.head_batch),
                draw(latents, optim.consistency_batch),
                draw(outlines, optim.consistency_batch),
                draw(data.targets.shape[1], 1),
            )


class PriorData(LightningDataModule):
    """Serves one epoch of `optim.steps` random batches."""

    def __init__(self, prepared: Prepared, config: TrainingConfig) -> None:
        super().__init__()
        self.prepared, self.config = prepared, config

    def train_dataloader(self) -> DataLoader:
        """One pass is the whole training."""
        return DataLoader(_Draws(self.prepared, self.config), batch_size=None)


def _float(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def _same_count(vertices: list[np.ndarray]) -> np.ndarray:
    """Stack polygons of different vertex counts by repeating each last vertex."""
    most = max(len(v) for v in vertices)
    return np.stack([np.pad(v, ((0, most - len(v)), (0, 0)), mode="edge") for v in vertices])
