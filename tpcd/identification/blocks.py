"""Least squares over blocks of time, so that slow noise does not pass for many observations.

Each block leaves its sums of squares and products; leaving out one block after another (jackknife,
Quenouille 1956; of blocks, Künsch 1989) gives the standard error of anything computed from them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from tpcd.identification.quantity import LEVEL

MOST_BLOCKS, FEWEST_BLOCKS = 40, 5
LENGTHS = 6.0
"""Correlation times that a block holds at least, so that blocks are nearly independent."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Values with standard errors from leaving out one block after another."""

    value: Float[np.ndarray, "..."]
    error: Float[np.ndarray, "..."]
    freedom: int

    def bounds(
        self, level: float = LEVEL
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Lower and upper ends of the intervals, by Student's t."""
        half = student.ppf(0.5 + level / 2, self.freedom) * self.error
        return np.asarray(self.value - half), np.asarray(self.value + half)

    def parts(self) -> list[Estimate]:
        """Each value of a vector by itself."""
        pairs = zip(self.value, self.error, strict=True)
        return [Estimate(np.asarray(v), np.asarray(e), self.freedom) for v, e in pairs]


def correlation_time(values: Float[np.ndarray, " n"]) -> float:
    """How many samples apart readings of a series are independent: 1 + 2 (sum of correlations up
    to the first that is not positive) (Geyer 1992), at least 1."""
    centred = values - values.mean()
    size = 1 << (2 * len(values) - 1).bit_length()
    spectrum = np.fft.rfft(centred, size)
    covariance = np.fft.irfft(spectrum * spectrum.conj(), size)[: len(values)]
    if covariance[0] <= 0:
        return 1.0
    correlations = covariance / covariance[0]
    ends = np.flatnonzero(correlations <= 0)
    upto = int(ends[0]) if len(ends) else len(values)
    return max(1.0, float(2 * correlations[:upto].sum() - 1))


def block_edges(count: int, time: float) -> np.ndarray:
    """Where blocks of `count` samples begin, that are `LENGTHS` correlation times long where the
    recording holds `FEWEST_BLOCKS` of those."""
    blocks = int(np.clip(count / (LENGTHS * time), FEWEST_BLOCKS, MOST_BLOCKS))
    return np.unique(np.linspace(0, count, blocks + 1).astype(int)[:-1])


def moments(columns: Float[np.ndarray, "n p"], edges: np.ndarray) -> Float[np.ndarray, "B p p"]:
    """Sums of products of the columns over each block."""
    ends = np.append(edges[1:], len(columns))
    return np.stack(
        [columns[a:b].T @ columns[a:b] for a, b in zip(edges, ends, strict=True)], axis=0
    )


def jackknife(
    compute: Callable[[Float[np.ndarray, "..."]], Float[np.ndarray, "..."]],
    sums: Float[np.ndarray, "B ..."],
) -> Estimate:
    """What `compute` makes of the sum over all blocks, and how far it depends on each of them."""
    total = sums.sum(0)
    left = np.stack([np.asarray(compute(total - part)) for part in sums])
    count = len(sums)
    error = np.sqrt((count - 1) / count * ((left - left.mean(0)) ** 2).sum(0))
    return Estimate(np.asarray(compute(total)), np.asarray(error), count - 1)


def partial(products: Float[np.ndarray, "p p"], kept: int) -> Float[np.ndarray, "k k"]:
    """Products of the first `kept` columns once the others were fitted away from them."""
    inner, across, rest = products[:kept, :kept], products[:kept, kept:], products[kept:, kept:]
    return inner - across @ solve(rest, across.T)


def solve(
    products: Float[np.ndarray, "p p"], right: Float[np.ndarray, "p k"]
) -> Float[np.ndarray, "p k"]:
    """Least-squares coefficients; those of columns that vary too little to be told are small."""
    scale = np.sqrt(np.diag(products))
    scale = np.where(scale > 0, scale, 1.0)[:, None]
    return np.linalg.pinv(products / scale / scale.T, rcond=1e-10) @ (right / scale) / scale
