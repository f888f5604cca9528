"""What has been learnt about the outline: an image of where the object is.

Each point of the plane shows the probability that it belongs to the object, the weighted
share of the particles whose outline encloses it, in the end-effector frame.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tpcd.figures.style import TEXT, TRUTH, Array, legend_below, panels


def outline_belief(
    points_ee: Float[Array, "m p 2"],
    weights: Float[Array, " m"],
    truth_points: Float[Array, "q 2"] | None = None,
    pixels: int = 300,
) -> Figure:
    """Draw the belief over the outline from m particles of p boundary points [m].

    `points_ee` are simple closed outlines in the end-effector frame, in order, without
    repeating the first point; `weights` need not be normalised. `truth_points` is the
    true outline in the same frame. `pixels` is the resolution along the longer side.
    """
    points = np.asarray(points_ee, dtype=float)
    corners = points.reshape(-1, 2)
    if truth_points is not None:
        truth = np.asarray(truth_points, dtype=float)
        corners = np.concatenate((corners, truth))
    low, high = corners.min(axis=0), corners.max(axis=0)
    spare = 0.06 * float((high - low).max())
    low, high = low - spare, high + spare
    pixel = float((high - low).max()) / pixels
    image = inside_probability(points, np.asarray(weights, dtype=float), low, high, pixel)

    size = 1e3 * pixel * np.array(image.shape[::-1])
    extent = (1e3 * low[0], 1e3 * low[0] + size[0], 1e3 * low[1], 1e3 * low[1] + size[1])
    figure, (panel,) = panels(1, 1, 5.2, 4.6)
    panel.grid(False)
    shown = panel.imshow(
        image, origin="lower", extent=extent, cmap="Blues", vmin=0, vmax=1, interpolation="nearest"
    )
    handles = {}
    if image.min() < 0.5 < image.max():
        panel.contour(image, [0.5], origin="lower", extent=extent, colors="#D55E00", linewidths=1.4)
        handles["probability 0.5"] = Line2D([], [], color="#D55E00", linewidth=1.4)
    if truth_points is not None:
        closed = 1e3 * np.concatenate((truth, truth[:1]))
        (handles["true outline"],) = panel.plot(
            closed[:, 0], closed[:, 1], color=TRUTH, linestyle="--", linewidth=1.3
        )
    (handles["end effector"],) = panel.plot(
        0, 0, "+", color="0.35", markersize=11, markeredgewidth=1.6
    )
    panel.set_aspect("equal")
    panel.set_xlabel("x in the end-effector frame [mm]")
    panel.set_ylabel("z in the end-effector frame [mm]")
    bar = figure.colorbar(shown, ax=panel, shrink=0.85, ticks=np.linspace(0, 1, 6))
    bar.set_label("probability that the point is object", fontsize=TEXT)
    bar.ax.tick_params(labelsize=TEXT - 1)
    legend_below(figure, handles)
    return figure


def inside_probability(
    points: Float[np.ndarray, "m p 2"],
    weights: Float[np.ndarray, " m"],
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
    pixel: float,
) -> Float[np.ndarray, "rows columns"]:
    """Weighted share of the outlines that enclose each pixel centre of the box [low, high].

    Every edge that crosses a row of pixel centres adds its outline's weight, signed by its
    direction, at the column where it crosses; the running sum along the row is then the
    winding number of all outlines at once. Row 0 is the lowest.
    """
    columns, rows = np.ceil((high - low) / pixel).astype(int)
    share = weights / weights.sum()
    following = np.roll(points, -1, axis=1)
    doubled_area = (points[..., 0] * following[..., 1] - points[..., 1] * following[..., 0]).sum(1)
    strength = np.repeat(share * np.sign(doubled_area), points.shape[1])

    start = ((points - low) / pixel - 0.5).reshape(-1, 2)
    end = ((following - low) / pixel - 0.5).reshape(-1, 2)
    first = np.ceil(np.minimum(start[:, 1], end[:, 1])).astype(int)
    beyond = np.ceil(np.maximum(start[:, 1], end[:, 1])).astype(int)
    first, beyond = np.clip(first, 0, rows), np.clip(beyond, 0, rows)
    crossings = beyond - first
    edge = np.repeat(np.arange(len(start)), crossings)
    row = (
        first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(crossings) - crossings, crossings)
    )
    along = (row - start[edge, 1]) / (end[edge, 1] - start[edge, 1])
    crossing = start[edge, 0] + along * (end[edge, 0] - start[edge, 0])
    column = np.clip(np.ceil(crossing).astype(int), 0, columns)
    # Counter-clockwise outlines go down on their left side: entering adds, leaving takes away.
    signed = strength[edge] * np.sign(start[edge, 1] - end[edge, 1])
    flat = np.bincount(row * (columns + 1) + column, signed, minlength=rows * (columns + 1))
    return np.clip(np.cumsum(flat.reshape(rows, columns + 1), axis=1)[:, :columns], 0.0, 1.0)
