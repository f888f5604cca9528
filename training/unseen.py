"""How well a prior fits objects it has not seen: the misfit in its card."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from tpcd.shape.deepsdf import DeepSDFShape
from tpcd.shape.protocol import Misfit
from tpcd.shape.ycb import load_ycb, ycb_folder
from training.config import DataConfig
from training.evaluate import MM, Spread, support_of
from training.fit import HULL_DIRECTIONS, best_fit
from training.misfit import measure_misfit, root_mean_square
from training.outlines import suitable


@dataclass(frozen=True, eq=False)
class UnseenReport:
    """Best-fit errors on unseen outlines."""

    figures: dict[str, object]
    """Errors in mm, for the card."""
    misfit: Misfit
    """How outlines differ from their best fits."""


def object_of(name: str) -> str:
    """The object a view or mirrored copy belongs to; the 065 cups count as one object."""
    base = name.split("/")[0]
    return "065_cups" if base.startswith("065-") else base


def unseen_outlines(
    trained: tuple[str, ...], config: DataConfig
) -> dict[str, Float64[np.ndarray, "_ 2"]]:
    """Suitable main views of YCB objects of which no view was trained on; {} without YCB."""
    if ycb_folder() is None:
        return {}
    seen = {object_of(name) for name in trained}
    views = {name: outline.vertices for name, outline in load_ycb("main").items()}
    return {n: v for n, v in views.items() if object_of(n) not in seen and suitable(v, config)}


def measure_unseen(
    shape: DeepSDFShape,
    outlines: dict[str, Float64[np.ndarray, "_ 2"]],
    trained: dict[str, Float64[np.ndarray, "_ 2"]],
    seed: int = 0,
) -> UnseenReport:
    """Fit every outline with and without scale and mount; `trained` are those of the training."""
    generator = torch.Generator().manual_seed(seed)
    with_scene = {n: best_fit(shape, v, generator) for n, v in outlines.items()}
    alone = {n: best_fit(shape, v, generator, scene=False) for n, v in outlines.items()}
    hull = {n: root_mean_square(f.hull_errors_mm) for n, f in with_scene.items()}
    sizes = np.array(list(hull.values()))
    unseen = [np.stack((fit.hull_errors_mm, fit.hull_slopes_mm)) for fit in with_scene.values()]
    known = [
        MM * (support_of(_decoded(shape, n), HULL_DIRECTIONS) - support_of(v, HULL_DIRECTIONS))
        for n, v in trained.items()
    ]
    report = measure_misfit(unseen, known, seed)
    figures: dict[str, object] = {
        "outlines": len(outlines),
        "best_fit_mm": vars(Spread.of(_pooled(with_scene))),
        "best_fit_latent_only_mm": vars(Spread.of(_pooled(alone))),
        "hull_rms_mm": round(float(np.sqrt(np.square(sizes).mean())), 4),
        "hull_rms_mm_median": round(float(np.median(sizes)), 4),
        "hull_rms_mm_by_outline": {name: round(size, 4) for name, size in hull.items()},
        "mean_mm_by_outline": {
            name: round(float(fit.errors_mm.mean()), 3) for name, fit in with_scene.items()
        },
        "fitted": "latent, scale in [0.8, 1.2], mount within 20 mm and 0.2 rad",
        "misfit_within_intervals": report.held,
    }
    return UnseenReport(figures, report.misfit)


def _decoded(shape: DeepSDFShape, name: str) -> Float64[np.ndarray, "p 2"]:
    """The outline that a training outline has become [m]."""
    return shape.boundary_points(shape.code_of(name)).detach().numpy()


def _pooled(fits: dict) -> np.ndarray:
    return np.concatenate([fit.errors_mm for fit in fits.values()])
