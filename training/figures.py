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
from tpcd.shape.levelset import decode, decode_many

MM = 1000.0
BLUE, RED, GREY = "#1f6f9f", "#b3262a", "#9a9a9a"


def outline_gallery(
    shape: DeepSDFShape, outlines: dict[str, Float64[np.ndarray, "_ 2"]], most: int = 42
) -> Figure:
    """True outlines (grey), level sets of f at their codes (blue), head points (red)."""
    chosen = dict(list(outlines.items())[:most])
    columns = min(7, len(chosen))
    rows = math.ceil(len(chosen) / columns)
    figure = Figure(figsize=(2.2 * columns, 2.4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (name, vertices) in zip(axes.flat, chosen.items(), strict=False):
        _draw_outline(axis, shape, name, vertices)
        axis.set_title(name, fontsize=7)
    return figure


def worst_outline(
    shape: DeepSDFShape, name: str, vertices: Float64[np.ndarray, "_ 2"], error_mm: float
) -> Figure:
    """One outline enlarged, with axes in mm."""
    figure = Figure(figsize=(8, 8), layout="constrained")
    axis = figure.subplots()
    _draw_outline(axis, shape, name, vertices, point_size=9)
    axis.set_title(f"worst outline: {name}, mean error {error_mm:.2f} mm")
    axis.set_xlabel("x [mm]")
    axis.set_ylabel("z [mm]")
    axis.grid(alpha=0.3)
    return figure


def latent_map(shape: DeepSDFShape, per_side: int = 21) -> Figure:
    """Decoded outlines on a grid of the latent plane; invalid places have a red cross.

    With more than two latents the plane is that of the first two, the others held at the
    nearest training code.
    """
    figure = Figure(figsize=(12, 12), layout="constrained")
    axis = figure.subplots()
    ticks = torch.linspace(-1, 1, per_side, dtype=torch.float64) * (1 - 1 / per_side)
    plane = torch.cartesian_prod(ticks, ticks)
    codes = shape.codes
    nearest = torch.cdist(plane, codes[:, :2]).argmin(1)
    latents = torch.cat((plane, codes[nearest, 2:]), dim=1)
    valid = shape.valid(latents)
    pitch = float(ticks[1] - ticks[0])
    factor = 0.9 * pitch / 0.25
    for where, ok, found in zip(plane, valid, decode_many(shape, latents, 0.004), strict=True):
        if not ok:
            axis.plot(*where, "x", color=RED, markersize=4)
        for curve in found.closed:
            placed = factor * np.vstack((curve, curve[:1])) + where.numpy()
            axis.plot(*placed.T, color=BLUE if ok else GREY, linewidth=0.8)
    axis.plot(*codes[:, :2].T, "o", color="black", markersize=3)
    for name, code in zip(shape.names, codes, strict=True):
        if len(shape.names) <= 40:
            axis.annotate(name[:14], code[:2].tolist(), fontsize=7, color="black")
    axis.set(xlim=(-1.02, 1.02), ylim=(-1.02, 1.02), xlabel="latent 0", ylabel="latent 1")
    axis.set_aspect("equal")
    axis.set_title("decoded outlines; red cross: not valid, never drawn; dots: training outlines")
    return figure


def _draw_outline(
    axis: Axes,
    shape: DeepSDFShape,
    name: str,
    vertices: Float64[np.ndarray, "_ 2"],
    point_size: float = 2.0,
) -> None:
    latent = shape.code_of(name)
    axis.plot(*(MM * np.vstack((vertices, vertices[:1])).T), color=GREY, linewidth=2.5)
    for curve in decode(shape, latent).closed:
        axis.plot(*(MM * np.vstack((curve, curve[:1])).T), color=BLUE, linewidth=0.9)
    head = MM * shape.boundary_points(latent).detach().numpy()
    axis.plot(*head.T, ".", color=RED, markersize=point_size)
    axis.set_aspect("equal")
