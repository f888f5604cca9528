"""What can be set about the training of a prior; YAML files hold what differs from this."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal


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
        _require(self, 0, "smallest_size", "builtin_variants")
        _require(self, self.smallest_size, "largest_size")


@dataclass(frozen=True)
class LayoutConfig:
    """Correspondence, initial codes and the latents in between."""

    points: int = 128
    """Points of the outline head."""
    rounding: float = 0.001
    """Smallest radius of a corner of the head's targets [m]."""
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
    between_samples: int = 120
    """Points with known signed distance around each outline in between."""
    near_spread: float = 0.0015
    """Standard deviation of the points near the outline [m]."""
    far_spread: float = 0.012
    """Standard deviation of the points further from the outline [m]."""

    def __post_init__(self) -> None:
        _require(self, 8, "points")
        _require(self, 1, "attempts", "neighbours", "components", "between")
        _require(self, 10, "object_samples", "between_samples")
        _require(self, 0, "rounding", "turning_share", "jitter", "near_spread", "far_spread")
        if self.turning_share > 1 or not 0 < self.extent <= 1:
            raise ValueError(
                f"turning_share is {self.turning_share} and extent {self.extent}, "
                "expected at most 1 and extent above 0"
            )


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks and the frequencies that they start with."""

    latent_dim: int = 2
    """Size z of the latent."""
    sdf_width: int = 128
    """Units of each hidden layer of the signed distance."""
    sdf_depth: int = 4
    """Hidden layers of the signed distance."""
    head_width: int = 256
    """Units of each hidden layer of the outline head."""
    head_depth: int = 3
    """Hidden layers of the outline head."""
    disc_radius: float = 0.05
    """The network learns the difference from the distance to this disc [m]; 0: everything."""
    point_frequency: float = 6.0
    """Largest initial first-layer weight on a coordinate in units of 0.1 m."""
    latent_frequency: float = 3.0
    """Largest initial first-layer weight on a latent entry, in the signed distance."""
    head_frequency: float = 12.0
    """Largest initial first-layer weight on a latent entry, in the head."""

    def __post_init__(self) -> None:
        _require(self, 2, "latent_dim")
        _require(self, 1, "sdf_width", "sdf_depth", "head_width", "head_depth")
        _require(self, 0, "disc_radius")


@dataclass(frozen=True)
class OptimConfig:
    """Optimiser and loss weights. Muon moves the hidden matrices, Adam everything else."""

    steps: int = 2000
    """Optimiser steps."""
    batch: int = 2048
    """Points of a step."""
    between_share: float = 0.6
    """Share of a step's points that lie around outlines in between."""
    adam_rate: float = 5e-3
    """Peak learning rate of Adam."""
    muon_rate: float = 0.03
    """Peak learning rate of Muon; with Adam alone the error after as many steps was three
    times as large (21 outlines, 1000 steps)."""
    code_rate: float = 1e-3
    """Peak learning rate of the codes (Adam)."""
    gradient_weight: float = 3.0
    """Weight of |grad f - normal|^2 near the outline; it holds both eikonal and direction.
    After 1000 steps of `ycb-rich` the gradient norm was off by 0.107 with 0.3 and 0.072 with 1
    (batch 1536), by 0.056 with 1 and 0.045 with 3 (batch 3072); the outlines gained as well."""
    head_weight: float = 10.0
    """Weight of the squared distance of the head's points from their targets."""
    consistency_weight: float = 30.0
    """Weight of f(g(z); z)^2, from one third of the training on."""
    head_batch: int = 256
    """Latents of a step for the head's targets."""
    consistency_batch: int = 16
    """Latents in between, and outlines, of a step for f(g(z); z)^2."""
    consistency_points: int = 32
    """Head points of each of them, evenly spaced from a random one on."""
    refine_rounds: int = 2
    """Rounds of the last stage, in which the head learns the level set of the finished f."""
    refine_latents: int = 6000
    """Latents at which it does, spread as the prior will draw them."""
    refine_copies: int = 8
    """Copies of each code among them, since training outlines are to be met best."""
    refine_steps: int = 2000
    """Optimiser steps of each round."""
    seed: int = 0
    """Seed of every random draw."""
    threads: int = 2
    """Torch threads."""

    def __post_init__(self) -> None:
        _require(self, 1, "steps", "head_batch", "consistency_batch", "consistency_points")
        _require(self, 1, "refine_latents", "threads")
        _require(self, 2, "batch")
        _require(
            self,
            0,
            "refine_rounds",
            "refine_steps",
            "refine_copies",
            "adam_rate",
            "muon_rate",
            "code_rate",
        )
        if not 0 < self.between_share < 1:
            raise ValueError(f"between_share is {self.between_share}, expected between 0 and 1")


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
        _require(self, 1, "mask_cells", "floor_draws")
        _require(self, 4, "draws")


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


def _require(config: Any, least: float, *names: str) -> None:
    for name in names:
        if not getattr(config, name) >= least:
            raise ValueError(f"{name} is {getattr(config, name)}, expected at least {least}")
