"""A training that leads nowhere is stopped where that shows, not measured at its end."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tpcd.errors import TpcdError
from training.config import OptimConfig

DIVERGED = 100.0
"""A loss of more than so many times the first one has diverged: the first is that of random
weights, whose outlines are as wrong as outlines are large, and it is a mean square, so these are
ten times as wrong."""


class TrainingError(TpcdError):
    """A training that led to no usable prior."""


def check_loss(
    terms: Mapping[str, Float[Tensor, ""]], first: float | None, step: int, optim: OptimConfig
) -> None:
    """Refuse a loss that is not finite or has diverged.

    `terms` has the whole as "loss" and its weighted terms; `first` is the loss of step 1, None
    where that is not known.
    """
    loss = float(terms["loss"])
    if not math.isfinite(loss):
        parts = ", ".join(f"{name} {float(term):g}" for name, term in terms.items())
        raise TrainingError(f"the loss is {loss} at step {step} ({parts}); {_remedy(optim)}")
    if first is not None and loss > DIVERGED * first:
        raise TrainingError(
            f"the loss has grown from {first:.3g} to {loss:.3g} by step {step}; {_remedy(optim)}"
        )


def check_weights(network: nn.Module, step: int, optim: OptimConfig) -> None:
    """Refuse weights that are not finite."""
    for name, weight in network.named_parameters():
        if not torch.isfinite(weight).all():
            raise TrainingError(
                f"the weights '{name}' hold NaN or infinity after step {step}; {_remedy(optim)}"
            )


def _remedy(optim: OptimConfig) -> str:
    rates = ", ".join(
        f"optim.{name} ({getattr(optim, name):g})"
        for name in ("adam_rate", "muon_rate", "code_rate")
    )
    return f"train anew with a lower {rates}"
