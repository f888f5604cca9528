"""Sums of Student densities in compiled loops; see `proposals` and `flat_mixture`."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.loops import njit
from tpcd.simulator.batch import source_stamp


class Components(NamedTuple):
    """t components at each of k places in d dimensions: axes (d, d, k), coordinates `place`
    (d, k) of the places along them, `offset` of the centres and inverse spreads `sharpness`
    (t, d, k), and peak densities (t, k) up to a factor."""

    axes: np.ndarray
    place: np.ndarray
    offset: np.ndarray
    sharpness: np.ndarray
    peak: np.ndarray


def _compile_sum_range(stamp: int) -> Callable[..., None]:
    """The entry, the only function kept in numba's cache; `stamp` makes part of its key."""

    # Sums may be taken in another order, so that they run in vector registers; NaN and
    # infinity keep their meaning.
    @njit(
        cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"}
    )
    @no_type_check
    def sum_range(points, components, freedom, total, first, last):
        sizes, dimension, places = components.offset.shape
        power = freedom + dimension if stamp >= 0 else 0
        along, value = np.empty(places), np.empty(places)
        square = np.empty((sizes, places))
        for i in range(first, last):
            square[:] = 0.0
            for a in range(dimension):
                for k in range(places):
                    along[k] = -components.place[a, k]
                for b in range(dimension):
                    coordinate = points[i, b]
                    for k in range(places):
                        along[k] += components.axes[a, b, k] * coordinate
                for t in range(sizes):
                    for k in range(places):
                        scaled = along[k] - components.offset[t, a, k]
                        scaled *= components.sharpness[t, a, k]
                        square[t, k] += scaled * scaled
            # (1 + square / freedom)^(-power / 2) without logarithms: power is a whole number.
            for t in range(sizes):
                for k in range(places):
                    square[t, k] = 1.0 / (1.0 + square[t, k] / freedom)
                for k in range(places):
                    value[k] = math.sqrt(square[t, k]) if power % 2 else 1.0
                for _ in range(power // 2):
                    for k in range(places):
                        value[k] *= square[t, k]
                whole = 0.0
                for k in range(places):
                    whole += value[k] * components.peak[t, k]
                total[i, t] = whole

    return sum_range


sum_range = _compile_sum_range(source_stamp(sys.modules[__name__]))
"""Fill `total` (m, t) of points (m, d) `first` up to `last` with the sum of the densities over all
places, up to a factor: (points, components, freedom, total, first, last)."""


class FlatComponents(NamedTuple):
    """Components of w widths at each of k centres in standard units: b coordinates (b, k) of the
    centres, the `width` (w), and the share (w) of their distance that centres keep."""

    centres: np.ndarray
    width: np.ndarray
    kept: np.ndarray


def _compile_flat_sum_range(stamp: int) -> Callable[..., None]:
    """The entry, the only function kept in numba's cache; `stamp` makes part of its key."""

    @njit(
        cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"}
    )
    @no_type_check
    def flat_sum_range(points, components, freedom, total, first, last):
        narrow, count = components.centres.shape
        dimension = points.shape[1]
        power = freedom + dimension if stamp >= 0 else 0
        square, value = np.empty(count), np.empty(count)
        for i in range(first, last):
            rest = 0.0
            for b in range(narrow, dimension):
                rest += points[i, b] * points[i, b]
            for w in range(len(components.width)):
                square[:] = 0.0
                for b in range(narrow):
                    coordinate, kept = points[i, b], components.kept[w]
                    for k in range(count):
                        away = coordinate - kept * components.centres[b, k]
                        square[k] += away * away
                sharpness = 1.0 / (freedom * components.width[w] ** 2)
                for k in range(count):
                    square[k] = 1.0 / (1.0 + rest / freedom + square[k] * sharpness)
                for k in range(count):
                    value[k] = math.sqrt(square[k]) if power % 2 else 1.0
                for _ in range(power // 2):
                    for k in range(count):
                        value[k] *= square[k]
                whole = 0.0
                for k in range(count):
                    whole += value[k]
                total[i, w] = whole

    return flat_sum_range


flat_sum_range = _compile_flat_sum_range(source_stamp(sys.modules[__name__]))
"""Fill `total` (m, w) of points (m, d) `first` up to `last` with the sum of the densities over all
centres, up to a factor: (points, components, freedom, total, first, last)."""
