"""Independent streams of random numbers, named by whole numbers."""

from __future__ import annotations

import numpy as np
import torch


def stream(*names: int) -> torch.Generator:
    """A generator of its own for every sequence of whole numbers >= 0 (seed, row, ...)."""
    # Their number leads, since a seed sequence takes trailing zeros for nothing.
    entropy = [len(names), *(int(name) for name in names)]
    state = np.random.SeedSequence(entropy).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
