"""Figures of a prior: true and learned outlines, the latent plane, the worst outline."""

from __future__ import annotations

import math

import matplotlib

matplotlib.use("Agg")
import numpy as np
import torch
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tpcd.shape.deepsdf import DeepSDFShape

MM = 1000.0
BLUE, RED, GREY = "#1f6f9f", "#b3262a", "#c4c4c4"
BAR_MM = 20.0
"""Length of the scale bar in the gallery [mm]."""


def outline_gallery(
    shape: DeepSDFShape,
    outlines: dict[str, Float64[np.ndarray, "_ 2"]],
    errors_mm: dict[str, float],
    most: int = 42,
) -> Figure:
    """True and learned outlines at the codes, with the mean error of each; at most `most`."""
    names = list(outlines)
    picked = np.unique(np.linspace(0, len(names) - 1, min(most, len(names))).round().astype(int))
    columns = min(7, len(picked))
    rows = math.ceil(len(picked) / columns)
    figure = Figure(figsize=(2.2 * columns, 2.4 * rows + 0.8), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, index in zip(axes.flat, picked, strict=False):
        name = names[index]
        _draw_outline(axis, shape, name, outlines[name])
        _draw_scale_bar(axis)
        axis.set_title(f"{name}\n{errors_mm[name]:.2f} mm", fontsize=8)
    number = f"{len(picked)} of {len(names)}" if len(picked) < len(names) else f"{len(names)}"
    figure.suptitle(f"{number} training outlines, mean error of each; bars: {BAR_MM:.0f} mm")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=3, frameon=False, markerscale=4
    )
    return figure


def worst_outline(
    shape: DeepSDFShape, name: str, vertices: Float64[np.ndarray, "_ 2"], error_mm: float
) -> Figure:
    """One outline enlarged, with axes in mm."""
    figure = Figure(figsize=(8, 8), layout="constrained")
    axis = figure.subplots()
    _draw_outline(axis, shape, name, vertices, point_size=5)
    axis.set_title(f"worst training outline: {name}, mean error {error_mm:.2f} mm")
    axis.set_xlabel("x [mm]")
    axis.set_ylabel("z [mm]")
    axis.grid(alpha=0.3)
    axis.legend(loc="best")
    return figure


def latent_map(shape: DeepSDFShape, per_side: int = 21) -> Figure:
    """Decoded outlines on a grid of the latent plane; places that are not valid have a cross.

    With more than two latents the plane is that of the first two, the others held at the
    nearest training code.
    """
    figure = Figure(figsize=(12, 12.4), layout="constrained")
    axis = figure.subplots()
    ticks = torch.linspace(-1, 1, per_side, dtype=torch.float64) * (1 - 1 / per_side)
    plane = torch.cartesian_prod(ticks, ticks)
    codes = shape.codes
    nearest = torch.cdist(plane, codes[:, :2]).argmin(1)
    latents = torch.cat((plane, codes[nearest, 2:]), dim=1)
    valid = shape.valid(latents)
    pitch = float(ticks[1] - ticks[0])
    factor = 0.9 * pitch / 0.25
    if not valid.all():
        axis.plot(*plane[~valid].T, "x", color=RED, markersize=4, label="not valid, never drawn")
    decoded = shape.boundary_points(latents[valid]).detach().numpy()
    for where, outline in zip(plane[valid].numpy(), decoded, strict=True):
        placed = factor * np.vstack((outline, outline[:1])) + where
        axis.plot(*placed.T, color=BLUE, linewidth=0.8)
    axis.plot([], [], color=BLUE, linewidth=0.8, label="decoded outline")
    axis.plot(*codes[:, :2].T, "o", color="black", markersize=4, label="training outline")
    if len(shape.names) <= 40:
        for name, code in zip(shape.names, codes, strict=True):
            left = bool(code[0] > 0.7)
            axis.annotate(
                name,
                code[:2].tolist(),
                xytext=(-4 if left else 4, 0),
                textcoords="offset points",
                ha="right" if left else "left",
                va="center",
                fontsize=8,
                bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.5},
            )
    axis.set(xlim=(-1.02, 1.02), ylim=(-1.02, 1.02), xlabel="latent 0", ylabel="latent 1")
    axis.set_aspect("equal")
    scale = f"distance between centres of neighbours: {MM * pitch / factor:.0f} mm"
    rest = "" if shape.latent_dim == 2 else ", other latents as at the nearest training outline"
    axis.set_title(f"latent plane and what it decodes to{rest}\n{scale}")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    return figure


def _draw_outline(
    axis: Axes,
    shape: DeepSDFShape,
    name: str,
    vertices: Float64[np.ndarray, "_ 2"],
    point_size: float = 1.6,
) -> None:
    latent = shape.code_of(name)
    closed = MM * np.vstack((vertices, vertices[:1]))
    axis.plot(*closed.T, color=GREY, linewidth=4, label="true outline")
    points = MM * shape.boundary_points(latent).detach().numpy()
    axis.plot(*np.vstack((points, points[:1])).T, color=BLUE, linewidth=1, label="learned outline")
    axis.plot(*points.T, ".", color=RED, markersize=point_size, label="its points")
    axis.set_aspect("equal")


def _draw_scale_bar(axis: Axes) -> None:
    left, right = axis.get_xlim()
    low = axis.get_ylim()[0] - 0.06 * (right - left)
    axis.plot([left, left + BAR_MM], [low, low], color="black", linewidth=2)
