"""What can be set about the training of a prior; YAML files hold what differs from this."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tpcd.cli import check_numbers

LARGEST = 5.0
"""An outline larger than this was meant in another unit [m]."""


@dataclass(frozen=True)
class DataConfig:
    """Which outlines to train on."""

    source: Literal["ycb21", "ycb", "builtin"] = "ycb21"
    """`ycb21`: main outlines of 21 graspable YCB objects; `ycb`: main and extra views of all
    YCB objects; `builtin`: the outlines made in code."""
    smallest_size: float = 0.04
    """Outlines whose longer side is less are not suitable [m] (not asked of `ycb21`)."""
    largest_size: float = 0.26
    """Outlines whose longer side is more are not suitable [m] (not asked of `ycb21`)."""
    mirror: bool = False
    """Also train on each outline mirrored left to right."""
    builtin_variants: int = 0
    """Random variants of the built-in outlines to train on as well."""
    leave_out: list[str] = field(default_factory=list)
    """Objects to leave out, by the beginning of their names; all their views go."""
    only: list[str] = field(default_factory=list)
    """If not empty, train on these names alone."""

    def __post_init__(self) -> None:
        check_numbers(self, {"smallest_size": 0, "builtin_variants": 0})
        check_numbers(self, {"largest_size": self.smallest_size}, most={"largest_size": LARGEST})
        if any(not name for name in (*self.leave_out, *self.only)):
            raise ValueError("leave_out or only holds an empty name, expected names of outlines")


@dataclass(frozen=True)
class LayoutConfig:
    """Correspondence, initial codes and the latents in between."""

    points: int = 128
    """Points of a decoded outline."""
    rounding: float = 0.001
    """Smallest radius of a corner of the outlines to be met [m]."""
    turning_share: float = 0.5
    """Share of turning angle, against arc length, in the spacing of the points."""
    extent: float = 0.92
    """Largest absolute coordinate of an initial code."""
    attempts: int = 6
    """Site layouts to try (two dimensions); the one with the most alike neighbours wins."""
    neighbours: int = 12
    """Morphs combine three of a code and its this many nearest codes (more dimensions)."""
    jitter: float = 0.1
    """Noise on latents in between, as a share of the codes' standard deviation."""
    components: int = 24
    """Components of the fitted density (more dimensions)."""
    between: int = 8000
    """Latents in between to train on."""
    object_samples: int = 8000
    """Points with known signed distance around each outline."""
    near_spread: float = 0.0015
    """Standard deviation of the points near the outline [m]."""
    far_spread: float = 0.012
    """Standard deviation of the points further from the outline [m]."""

    def __post_init__(self) -> None:
        least = {"points": 8, "attempts": 1, "neighbours": 2, "components": 1, "between": 1}
        least |= {"object_samples": 10, "rounding": 0, "turning_share": 0, "jitter": 0}
        check_numbers(self, {**least, "near_spread": 0, "far_spread": 0})
        _check_most(self, points=4096, attempts=10_000, components=10_000, between=10_000_000)
        _check_most(self, object_samples=1_000_000, rounding=0.1, near_spread=1.0, far_spread=1.0)
        if self.turning_share > 1 or not 0 < self.extent <= 1:
            raise ValueError(
                f"turning_share is {self.turning_share} and extent {self.extent}, "
                "expected at most 1 and extent above 0"
            )


@dataclass(frozen=True)
class NetworkConfig:
    """Size of the decoder and the frequency that it starts with."""

    latent_dim: int = 2
    """Size z of the latent."""
    width: int = 256
    """Units of each hidden layer of the decoder."""
    depth: int = 3
    """Hidden layers."""
    frequency: float = 12.0
    """Largest initial first-layer weight on a latent entry."""

    def __post_init__(self) -> None:
        check_numbers(self, {"latent_dim": 2, "width": 1, "depth": 1, "frequency": 0})
        _check_most(self, width=16_384, depth=64, frequency=1000.0)


@dataclass(frozen=True)
class OptimConfig:
    """Optimiser and loss weights. Muon moves the hidden matrices, Adam everything else."""

    steps: int = 3000
    """Optimiser steps."""
    batch: int = 2048
    """Points of a step at which signed distances are compared."""
    latents: int = 256
    """Latents in between of a step."""
    adam_rate: float = 5e-3
    """Peak learning rate of Adam."""
    muon_rate: float = 0.03
    """Peak learning rate of Muon; with Adam alone the error after as many steps was three
    times as large (21 outlines, 1000 steps)."""
    code_rate: float = 1e-4
    """Peak learning rate of the codes (Adam); with ten times as much, training outlines are met
    no better and unseen ones half as well."""
    distance_weight: float = 1.0
    """Weight of (f - d)^2 at points around the outlines."""
    support_weight: float = 1.0
    """Weight of the squared error of the support functions of the outlines."""
    outline_weight: float = 1.0
    """Weight of the squared distance of decoded points from where they should be."""
    seed: int = 0
    """Seed of every random draw."""
    threads: int = 2
    """Torch threads."""

    def __post_init__(self) -> None:
        least = {"steps": 1, "batch": 1, "latents": 1, "threads": 1}
        rates = {"adam_rate": 0, "muon_rate": 0, "code_rate": 0}
        weights = {"distance_weight": 0, "support_weight": 0, "outline_weight": 0}
        check_numbers(self, {**least, **rates, **weights})
        _check_most(self, steps=100_000_000, batch=10_000_000, latents=1_000_000, threads=1024)
        _check_most(self, distance_weight=1e6, support_weight=1e6, outline_weight=1e6)
        if self.distance_weight == self.support_weight == self.outline_weight == 0:
            raise ValueError(f"{' and '.join(weights)} are 0, expected one of them above")


@dataclass(frozen=True)
class CheckConfig:
    """How the finished prior is checked."""

    mask_cells: int = 64
    """Cells along each side of the mask of valid latents (two dimensions)."""
    floor_draws: int = 3000
    """Draws of the mixture that are decoded to find its density floor (more dimensions)."""
    draws: int = 1500
    """Draws of the finished prior that are decoded for its card."""
    unseen: bool = True
    """Fit the YCB objects that were not trained on, where their outlines are to be had."""

    def __post_init__(self) -> None:
        check_numbers(self, {"mask_cells": 1, "floor_draws": 1, "draws": 4})
        _check_most(self, mask_cells=1024, floor_draws=1_000_000, draws=1_000_000)


@dataclass(frozen=True)
class TrainingConfig:
    """One prior."""

    name: str = "prior"
    """Name of the prior and of its checkpoint folder."""
    unseen_from: str = ""
    """Prior of the same recipe with objects left out, whose unseen errors the card quotes."""
    data: DataConfig = field(default_factory=DataConfig)
    """Which outlines."""
    layout: LayoutConfig = field(default_factory=LayoutConfig)
    """How they are arranged."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Which networks."""
    optim: OptimConfig = field(default_factory=OptimConfig)
    """How they learn."""
    check: CheckConfig = field(default_factory=CheckConfig)
    """How the result is checked."""

    def __post_init__(self) -> None:
        if self.name in ("", ".", "..") or Path(self.name).name != self.name:
            raise ValueError(f"name is {self.name!r}, expected the plain name of a folder")
        needed = 2 * self.layout.components
        if self.network.latent_dim > 2 and self.layout.between < needed:
            raise ValueError(
                f"layout.between is {self.layout.between}, expected at least {needed}: half of "
                "them, one for each of layout.components"
            )


def _check_most(config: object, **most: float) -> None:
    """Refuse numbers by which the work would not fit into a machine, or that are a slip."""
    for name, limit in most.items():
        if getattr(config, name) > limit:
            raise ValueError(f"{name} is {getattr(config, name)}, expected at most {limit}")
