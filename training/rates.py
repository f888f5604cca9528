"""The optimisers and learning rates that all stages share.

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
    networks: list[nn.Sequential],
    codes: list[nn.Parameter],
    adam_rate: float,
    muon_rate: float,
    code_rate: float,
) -> list[torch.optim.Optimizer]:
    """Adam for first layers, biases, one-row layers and codes; Muon for the other weights."""
    linear = [[layer for layer in mlp if isinstance(layer, nn.Linear)] for mlp in networks]
    hidden = [layer.weight for mlp in linear for layer in mlp[1:] if len(layer.weight) > 1]
    taken = {id(weight) for weight in hidden}
    others = [p for mlp in networks for p in mlp.parameters() if id(p) not in taken]
    groups = [{"params": others, "lr": adam_rate}]
    if codes:
        groups.append({"params": codes, "lr": code_rate})
    return [
        torch.optim.Adam(groups, betas=(0.9, 0.99)),
        Muon(hidden, lr=muon_rate),
    ]
