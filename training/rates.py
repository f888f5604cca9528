"""The optimisers and learning rates.

Muon (see `muon`) moves the hidden matrices, Adam everything else; both follow a linear
warm-up and half a cosine.
"""

from __future__ import annotations

import math

import torch
from torch import nn

from training.muon import Muon

WARM_UP = 50
"""Steps over which the learning rates rise."""
LEAST = 0.002
"""Share of the peak rate that is left at the end."""


def cosine_rate(step: int, steps: int) -> float:
    """Share of the peak learning rate at a step of `steps`."""
    done = min(step / steps, 1.0)
    return min(1.0, (step + 1) / WARM_UP) * 0.5 * (1 + math.cos(math.pi * done)) + LEAST


def split_optimizers(
    network: nn.Sequential,
    codes: nn.Parameter,
    adam_rate: float,
    muon_rate: float,
    code_rate: float,
) -> list[torch.optim.Optimizer]:
    """Adam for the first layer, biases and codes; Muon for the other weights."""
    linear = [layer for layer in network if isinstance(layer, nn.Linear)]
    hidden = [layer.weight for layer in linear[1:]]
    others = [linear[0].weight, *(layer.bias for layer in linear)]
    groups = [{"params": others, "lr": adam_rate}, {"params": [codes], "lr": code_rate}]
    return [
        torch.optim.Adam(groups, betas=(0.9, 0.99)),
        Muon(hidden, lr=muon_rate),
    ]
