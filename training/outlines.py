"""The outlines a prior is trained on, chosen by `DataConfig`."""

from __future__ import annotations

import hashlib

import numpy as np
from jaxtyping import Float64

from tpcd.shape.builtin import builtin_outlines, random_outlines
from tpcd.shape.ycb import GRASPABLE_21, load_ycb
from training.config import DataConfig

MIRRORED = "/mirrored"
"""Ending of the name of a mirrored copy."""


def training_outlines(
    config: DataConfig, rng: np.random.Generator
) -> dict[str, Float64[np.ndarray, "_ 2"]]:
    """Vertices by name [m], counter-clockwise, origin at the area centroid.

    Raises:
        FileError: the YCB outlines are asked for and not there.
        ValueError: nothing is left to train on.
    """
    if config.source == "builtin":
        found = {name: outline.vertices for name, outline in builtin_outlines().items()}
    else:
        views = load_ycb("main" if config.source == "ycb21" else "all")
        found = {name: outline.vertices for name, outline in views.items()}
    idle = [n for n in config.leave_out if not any(name.startswith(n) for name in found)]
    if idle:
        raise ValueError(
            f"data.leave_out names {', '.join(idle)}, with which no outline's name begins; expected"
            f" beginnings of {', '.join(found)}"
        )
    if config.source == "ycb21":
        found = {name: found[name] for name in GRASPABLE_21}
    else:
        found = {name: v for name, v in found.items() if suitable(v, config)}
    if config.only:
        unknown = sorted(set(config.only) - set(found))
        if unknown:
            raise ValueError(
                f"data.only names {', '.join(unknown)}, expected names among {', '.join(found)}"
            )
        found = {name: found[name] for name in config.only}
    found = {n: v for n, v in found.items() if not n.startswith(tuple(config.leave_out))}
    for outline in random_outlines(config.builtin_variants, rng):
        if suitable(outline.vertices, config):
            found[f"builtin/{outline.name}"] = outline.vertices
    if config.mirror:
        found |= {name + MIRRORED: mirrored(v) for name, v in found.items()}
    if len(found) < 3:
        raise ValueError(f"{len(found)} outlines are left to train on, expected at least 3")
    return found


def suitable(vertices: Float64[np.ndarray, "_ 2"], config: DataConfig) -> bool:
    """Whether a gripper could hold and a sensor could feel it: its longer side fits."""
    longer = float(np.ptp(vertices, axis=0).max())
    return config.smallest_size <= longer <= config.largest_size


def mirrored(vertices: Float64[np.ndarray, "_ 2"]) -> Float64[np.ndarray, "_ 2"]:
    """The outline seen from behind: x reversed, still counter-clockwise."""
    return vertices[::-1] * np.array([-1.0, 1.0])


def data_hash(outlines: dict[str, Float64[np.ndarray, "_ 2"]]) -> str:
    """SHA-256 of names and vertices, in order."""
    digest = hashlib.sha256()
    for name, vertices in outlines.items():
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(vertices, dtype="<f8").tobytes())
    return digest.hexdigest()
