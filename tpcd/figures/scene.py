"""The movement of the object in the world, with what is believed of floor and wall.

Outlines from first (light) to last step (dark) with the force that pushes on each, the path of
the end effector, and floor and wall as lines with their 90 % bands.
"""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from tpcd.figures.style import FLOOR, FORCE, TRUTH, WALL, Array, LegendKey, legend_below, panels

MOST_OUTLINES = 12
"""More outlines than this in one picture hide each other."""
LEAST_FORCE = 0.1
"""Forces below this share of the largest one are not drawn."""
FORCE_LENGTH = 0.35
"""Length of the arrow of the largest force, as a share of the object's size."""


def scene(
    poses: Float[Array, "n 3"],
    points_ee: Float[Array, "p 2"],
    floor: tuple[float, float, float],
    wall: tuple[float, float, float],
    *,
    true_floor: float | None = None,
    true_wall: float | None = None,
    commands: Float[Array, "n 3"] | None = None,
    wrenches: Float[Array, "n 3"] | None = None,
    outline: str = "",
) -> Figure:
    """Draw n poses [m, m, rad] of an outline given in the end-effector frame [m].

    `floor` and `wall` are (mean, low, high) of the floor's z and the wall's x [m] in the
    world; `true_floor` and `true_wall` add dashed lines, `commands` the commanded path, and
    `wrenches` (F_x, F_z, torque about the end effector) [N, N, N·m] an arrow where the line of the
    force enters the outline, which for a single contact is the contact point. What is to be said
    of the outline goes to the legend.
    """
    poses, points = np.asarray(poses, dtype=float), 1e3 * np.asarray(points_ee, dtype=float)
    figure, (panel,) = panels(1, 1, 6.4, 4.8)
    panel.grid(False)
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MOST_OUTLINES)).astype(int))
    colours = colormaps["Blues"](np.linspace(0.25, 0.95, len(chosen)))
    outlines = [_placed(points, poses[k]) for k in chosen]
    for placed, colour in zip(outlines, colours, strict=True):
        panel.add_patch(Polygon(placed, closed=True, fill=False, edgecolor=colour, linewidth=1.1))
    path = 1e3 * poses[:, :2]
    panel.plot(*path.T, color="0.25", linewidth=1.0, marker="o", markersize=2.5)
    drawn_as = f"object ({outline})" if outline else "object"
    entries: dict[str, LegendKey] = {
        f"{drawn_as} at step {chosen[0]}": Line2D([], [], color=colours[0]),
        f"object at step {chosen[-1]}": Line2D([], [], color=colours[-1]),
        "end effector": Line2D([], [], color="0.25", marker="o", markersize=3),
    }
    drawn = [np.concatenate(outlines), path]
    if commands is not None:
        commanded = 1e3 * np.asarray(commands, dtype=float)[:, :2]
        (entries["command"],) = panel.plot(
            *commanded.T, color="#D55E00", linewidth=1.3, linestyle=":"
        )
        drawn.append(commanded)
    if wrenches is not None:
        size = float(np.ptp(points, axis=0).max())
        forces = np.asarray(wrenches, dtype=float)[chosen]
        arrows, largest = _force_arrows(outlines, path[chosen], forces, FORCE_LENGTH * size)
        if len(arrows):
            tails, ways = arrows[:, 0], arrows[:, 1] - arrows[:, 0]
            panel.quiver(
                *tails.T, *ways.T, color=FORCE, angles="xy", scale_units="xy", scale=1.0,
                width=0.005, zorder=3,
            )  # fmt: skip
            key = Line2D([], [], color=FORCE, marker=">", markersize=4)
            entries[f"contact force, at most {largest:.1f} N"] = key
            drawn.append(tails)

    low, high = np.concatenate(drawn).min(axis=0), np.concatenate(drawn).max(axis=0)
    surfaces = [
        1e3 * np.array([*belief, belief[0] if truth is None else truth])
        for belief, truth in ((wall, true_wall), (floor, true_floor))
    ]
    # The surfaces belong in the picture unless they are far from everything that happened.
    reach = float((high - low).max())
    for axis, surface in enumerate(surfaces):
        if surface.min() < high[axis] + reach and surface.max() > low[axis] - reach:
            low[axis], high[axis] = min(low[axis], surface.min()), max(high[axis], surface.max())
    spare = 0.05 * float((high - low).max())
    panel.set_xlim(low[0] - spare, high[0] + spare)
    panel.set_ylim(low[1] - spare, high[1] + spare)
    entries["floor, mean and 90 %"] = _surface(panel, "h", floor, FLOOR)
    entries["wall, mean and 90 %"] = _surface(panel, "v", wall, WALL)
    dashed = {"color": TRUTH, "linewidth": 1.2, "linestyle": "--"}
    if true_floor is not None:
        entries["true surface"] = panel.axhline(1e3 * true_floor, **dashed)
    if true_wall is not None:
        entries["true surface"] = panel.axvline(1e3 * true_wall, **dashed)
    panel.set_aspect("equal")
    # As high as the drawing needs, so that a long flat path leaves no empty bands.
    width, height = panel.get_xlim()[1] - panel.get_xlim()[0], high[1] - low[1] + 2 * spare
    figure.set_figheight(float(np.clip(5.6 * height / width + 0.6, 2.4, 6.4)))
    panel.set_xlabel("x in the world [mm]")
    panel.set_ylabel("z in the world [mm]")
    # Legend keys of drawn vertical lines are vertical; this one stands for both surfaces.
    if "true surface" in entries:
        entries["true surface"] = Line2D([], [], **dashed)
    legend_below(figure, entries, columns=3)
    return figure


def _force_arrows(
    outlines: list[np.ndarray], places: np.ndarray, wrenches: np.ndarray, length: float
) -> tuple[np.ndarray, float]:
    """Tails and tips [mm] of arrows (k, 2, 2) of forces that enter the outlines at their tips, the
    largest one of such a length, and its size [N]. `places` [mm] are those of the end effector."""
    size = np.linalg.norm(wrenches[:, :2], axis=-1)
    largest, arrows = float(size.max()), []
    for placed, place, wrench, force in zip(outlines, places, wrenches, size, strict=True):
        if not force > LEAST_FORCE * largest:
            continue
        way = wrench[:2] / force
        # Points r of the line of the force have the torque r x F.
        nearest = place + 1e3 * wrench[2] / force * np.array([way[1], -way[0]])
        reach = float(np.abs(placed - nearest).sum(axis=-1).max())
        line = shapely.LineString([nearest - reach * way, nearest + reach * way])
        met = shapely.get_coordinates(line.intersection(shapely.LinearRing(placed)))
        if len(met):
            tip = met[((met - nearest) @ way).argmin()]
            arrows.append((tip - length * force / largest * way, tip))
    return np.array(arrows), largest


def _surface(
    panel: Axes, direction: str, belief: tuple[float, float, float], colour: str
) -> tuple[Artist, ...]:
    """Draw mean and band of a horizontal ("h") or vertical surface; returns its legend key."""
    line, span = (
        (panel.axhline, panel.axhspan) if direction == "h" else (panel.axvline, panel.axvspan)
    )
    mean, low, high = (1e3 * value for value in belief)
    span(low, high, color=colour, alpha=0.3, linewidth=0)
    line(mean, color=colour, linewidth=1.6)
    return Patch(color=colour, alpha=0.3, linewidth=0), Line2D([], [], color=colour, linewidth=1.6)


def _placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points of the end-effector frame [mm] at a pose [m, m, rad], in the world [mm]."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    return points @ rotation.T + 1e3 * pose[:2]
