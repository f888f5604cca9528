"""Independent streams of random numbers, named by whole numbers."""

from __future__ import annotations

import numpy as np
import torch


def stream(*names: int) -> torch.Generator:
    """A generator of its own for every sequence of whole numbers >= 0 (seed, row, ...)."""
    state = np.random.SeedSequence([int(name) for name in names]).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
