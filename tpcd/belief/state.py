"""What an estimator needs to go on after a step: tensors by name, kept beside the belief.

Everything is stored exactly, the random generator included, so that a run that was stopped
and goes on gives the same numbers as one that was not.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_tensors
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.errors import RunError
from tpcd.files import write_bytes
from tpcd.shape.checkpoint import prior_hash

STATE_FILE = "state.safetensors"
STATE_VERSION = "11"
"""Changes with what an estimator keeps, and with what its likelihoods mean."""


@dataclass(frozen=True)
class EstimatorState:
    """The estimator after `index` transitions: named tensors, and the generator's state."""

    index: int
    tensors: Mapping[str, Tensor]
    generator: Tensor

    def restore(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Set the generator back and return the tensors."""
        generator.set_state(self.generator)
        return dict(self.tensors)


def save_state(state: EstimatorState, folder: Path, episode: Episode, prior: str | Path) -> None:
    """Write the state in one move, with fingerprints of the episode that it belongs to and of the
    shape prior (its folder or name)."""
    content = {name: value.contiguous() for name, value in state.tensors.items()}
    content["generator"] = state.generator
    card = {
        "version": STATE_VERSION,
        "index": str(state.index),
        "episode": fingerprint(episode),
        "prior": prior_hash(prior),
    }
    write_bytes(folder / STATE_FILE, save_tensors(content, card))


def load_state(
    folder: Path, episode: Episode, prior: str | Path, growing: bool = False
) -> EstimatorState | None:
    """Read the state back; None where no step was finished.

    With `growing`, the episode may have got further rows since. Raises `RunError`
    where it belongs to other data or another prior, or cannot be read.
    """
    path = folder / STATE_FILE
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            card = file.metadata()
            # Cloned, since products of matrices round by how their memory is aligned.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        index, of = int(card["index"]), card["episode"]
        generator = tensors.pop("generator")
    except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
        raise RunError(path, f"cannot be read ({error})", "estimate again") from error
    if card.get("version") != STATE_VERSION:
        raise RunError(path, "was left by another version of tpcd", "estimate again")
    if card.get("prior") != prior_hash(prior):
        fault = f"was made with other weights of the prior {prior}"
        raise RunError(path, fault, "estimate again")
    known = episode.first(index + 1) if growing else episode
    if of != fingerprint(known):
        raise RunError(path, "belongs to an episode with other numbers", "estimate again")
    return EstimatorState(index, tensors, generator)


def fingerprint(episode: Episode) -> str:
    """SHA-256 of the numbers an estimator reads."""
    digest = hashlib.sha256()
    for value in (
        episode.commands,
        episode.poses,
        episode.wrenches,
        episode.stiffness,
        episode.sensor_std,
    ):
        digest.update(value.double().contiguous().numpy().tobytes())
    digest.update(repr(sorted((episode.priors or {}).items())).encode())
    return digest.hexdigest()
