"""Built-in outlines of household objects, made in code from published dimensions.

They come from the entries in `household`, so a machine without any data set can train, simulate
and test. Outlines come out in metres, counter-clockwise, centred, with edges rounded by 1 to
3 mm. `random_outlines` draws variants with every dimension scaled by itself.
"""

from __future__ import annotations

import numpy as np
import shapely

from tpcd.errors import OutlineError
from tpcd.shape.drawing import rounded
from tpcd.shape.household import ENTRIES, Entry
from tpcd.shape.outline import Outline, make_outline

CURVE_TOLERANCE = 0.03
"""Largest distance between a drawn curve and its polygon [mm]."""
ATTEMPTS = 50
"""Draws of a variant before giving up; parts that fall apart or cross are drawn again."""


def builtin_outlines() -> dict[str, Outline]:
    """All built-in outlines by name [m]."""
    return {name: make_entry(name, entry) for name, entry in ENTRIES.items()}


def make_entry(name: str, entry: Entry) -> Outline:
    """Draw one entry [m].

    Raises:
        ValueError: its dimensions give no single piece.
        OutlineError: they give an outline of implausible size.
    """
    sharp = entry.maker(**entry.dimensions)
    smooth = rounded(sharp, entry.edge).simplify(CURVE_TOLERANCE)
    vertices = shapely.get_coordinates(smooth)[:-1] / 1000.0
    return make_outline(name, vertices, source=entry.source, notes="made in code")


def vary(entry: Entry, rng: np.random.Generator, spread: float = 0.25) -> Entry:
    """The entry with each dimension scaled by its own factor from U[1 - spread, 1 + spread]."""
    if not 0.0 <= spread < 1.0:
        raise ValueError(f"spread must lie in [0, 1), got {spread}")
    factors = rng.uniform(1 - spread, 1 + spread, len(entry.dimensions))
    sizes = {
        key: size * f for (key, size), f in zip(entry.dimensions.items(), factors, strict=True)
    }
    return Entry(entry.maker, sizes, f"{entry.source}, varied by {spread:.0%}", entry.edge)


def random_outlines(count: int, rng: np.random.Generator, spread: float = 0.25) -> list[Outline]:
    """Variants of randomly chosen entries, named `<entry>~<number>`; valid outlines only."""
    names = sorted(ENTRIES)
    outlines = []
    for index in range(count):
        name = names[rng.integers(len(names))]
        outlines.append(_draw_variant(f"{name}~{index}", ENTRIES[name], rng, spread))
    return outlines


def _draw_variant(name: str, entry: Entry, rng: np.random.Generator, spread: float) -> Outline:
    for _ in range(ATTEMPTS):
        variant = vary(entry, rng, spread)
        try:
            return make_entry(name, variant)
        except (ValueError, OutlineError):
            continue
    raise RuntimeError(f"no valid variant of {name} in {ATTEMPTS} draws at spread {spread}")
