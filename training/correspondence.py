"""Outlines brought into correspondence: the k-th point of one belongs to the k-th of all.

Each outline gets `points` vertices, evenly spaced in a mixed measure, half arc length and
half turning angle, so that corners, where contact happens, get dense points. The start
points are then shifted along the outlines so that they agree best with the running mean
(least squares over cyclic shifts, found by FFT). Convex combinations of outlines in
correspondence are the morphs that teach the networks what lies between the codes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float64
from shapely.geometry.polygon import orient

DENSE = 4096
"""Points of the fine uniform sampling of an outline."""
ALIGNING = 512
"""Points used to find the cyclic shift; the shift is a multiple of 1/512 of the outline."""
SMOOTHING = 0.0015
"""Width over which the turning angle is measured [m]: below it lies the scanners' noise."""


@dataclass(frozen=True, eq=False)
class MeasuredCurve:
    """A closed curve with its cumulative mixed measure, 0 at the start and 1 at the end."""

    points: Float64[np.ndarray, "n 2"]
    """Dense points [m], counter-clockwise."""
    measure: Float64[np.ndarray, " m"]
    """Cumulative measure at the points and, last, back at the start (m = n + 1)."""

    def at(self, positions: Float64[np.ndarray, " p"]) -> Float64[np.ndarray, "p 2"]:
        """Points at the given measures, taken modulo 1 [m]."""
        closed = np.vstack((self.points, self.points[:1]))
        wrapped = np.mod(positions, 1.0)
        return np.stack([np.interp(wrapped, self.measure, closed[:, i]) for i in (0, 1)], axis=-1)


def correspond(
    outlines: list[Float64[np.ndarray, "_ 2"]], points: int, rounding: float, turning_share: float
) -> Float64[np.ndarray, "n p 2"]:
    """Resample outlines [m] to `points` vertices each, in correspondence with one another."""
    curves = [measure(round_corners(v, rounding), turning_share) for v in outlines]
    shifts = _align(curves)
    positions = np.arange(points) / points
    return np.stack([c.at(positions + s) for c, s in zip(curves, shifts, strict=True)])


def round_corners(
    vertices: Float64[np.ndarray, "_ 2"], radius: float
) -> Float64[np.ndarray, "_ 2"]:
    """Round convex and concave corners to at least `radius` [m]; keeps the largest piece."""
    if radius <= 0:
        return vertices
    shape = shapely.Polygon(vertices)
    for distance in (-radius, 2 * radius, -radius):
        shape = shape.buffer(distance, quad_segs=12)
    if shape.geom_type == "MultiPolygon":
        shape = max(shape.geoms, key=lambda piece: piece.area)
    if shape.is_empty:
        return vertices
    return np.asarray(orient(shapely.Polygon(shape.exterior)).exterior.coords)[:-1]


def measure(vertices: Float64[np.ndarray, "_ 2"], turning_share: float) -> MeasuredCurve:
    """Mixed measure (1 - s) dl / L + s |dtheta| / sum |dtheta| along an outline."""
    closed = np.vstack((vertices, vertices[:1]))
    ends = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    at = np.linspace(0.0, ends[-1], DENSE, endpoint=False)
    dense = np.stack([np.interp(at, ends, closed[:, i]) for i in (0, 1)], axis=1)
    frequency = np.fft.fftfreq(DENSE, d=ends[-1] / DENSE)
    lowpass = np.exp(-2 * (np.pi * frequency * SMOOTHING) ** 2)
    smooth = np.fft.ifft(np.fft.fft(dense[:, 0] + 1j * dense[:, 1]) * lowpass)
    edges = np.roll(smooth, -1) - smooth
    turning = np.abs(np.angle(edges / np.roll(edges, 1)))
    rate = (1 - turning_share) / DENSE + turning_share * turning / turning.sum()
    return MeasuredCurve(dense, np.concatenate(([0.0], np.cumsum(rate))))


def _align(curves: list[MeasuredCurve]) -> Float64[np.ndarray, " n"]:
    """Start of each curve, as a share of it, that agrees best with the mean of all."""
    grid = np.arange(ALIGNING) / ALIGNING
    sampled = np.stack([c.at(grid) @ np.array([1.0, 1j]) for c in curves])
    sampled /= np.sqrt((np.abs(sampled) ** 2).mean(axis=1, keepdims=True))
    spectra = np.fft.fft(sampled, axis=1)
    shifts = np.abs(np.angle(sampled)).argmin(axis=1)
    for _ in range(20):
        rolled = [np.roll(curve, -shift) for curve, shift in zip(sampled, shifts, strict=True)]
        mean = np.fft.fft(np.mean(rolled, axis=0))
        # Correlation with the mean at every cyclic shift at once; its peak is the best fit.
        better = np.fft.ifft(spectra * mean.conj(), axis=1).real.argmax(axis=1)
        if np.array_equal(better, shifts):
            break
        shifts = better
    return shifts / ALIGNING
