"""A belief on disk: `belief.safetensors` beside `belief.json`, nothing unpickled.

The JSON says which tensors it belongs to, by their hash, and which shape prior it is, by its place
and by the hash of its weights, since particles mean nothing under another prior.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from tpcd.belief.belief import Belief
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior
from tpcd.effects.model import effects_from_plain, effects_to_plain
from tpcd.errors import RunError
from tpcd.files import write_bytes, write_json
from tpcd.records import fitting, read_entries
from tpcd.shape.checkpoint import load_prior, prior_record, recorded_prior
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings

FORMAT_VERSION = 6
_TENSORS = ("vectors", "weights", "misfit_sd", "misfit_mean", "misfit_covariance", "stiffness")


def save_belief(belief: Belief, folder: str | Path, prior: str | Path) -> Path:
    """Write the belief into a folder; `prior` is the checkpoint its latents belong to."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {name: getattr(belief, name).contiguous() for name in _TENSORS}
    tensors |= {"low": belief.prior.low, "high": belief.prior.high}
    data = save_tensors(tensors)
    write_bytes(folder / "belief.safetensors", data)
    return write_json(
        folder / "belief.json",
        {
            "format": "tpcd-belief",
            "format_version": FORMAT_VERSION,
            "tensors_sha256": sha256(data).hexdigest(),
            "names": list(belief.prior.names),
            "units": list(belief.prior.units),
            "effects": effects_to_plain(belief.prior.effects, fingerprints=True),
            **prior_record(prior, folder),
            "misfit": asdict(belief.misfit),
            "step": asdict(belief.step),
            "log_evidence": belief.log_evidence,
            "log_evidence_std": belief.log_evidence_std,
        },
    )


def load_belief(folder: str | Path, shape: Shape | None = None) -> Belief:
    """Read a belief back, with its shape prior unless `shape` is given.

    Raises `RunError` where the folder holds no belief of this version, `CheckpointError` where its
    prior is gone or another one than it was made with.
    """
    path = Path(folder) / "belief.json"
    if not path.is_file():
        raise RunError(path, "no such file", "give the folder that estimate wrote")
    card = read_entries(path, "estimate again")
    if card.get("format") != "tpcd-belief" or card.get("format_version") != FORMAT_VERSION:
        text = f"{card.get('format')} version {card.get('format_version')}"
        raise RunError(
            path,
            f"holds {text}, expected tpcd-belief version {FORMAT_VERSION}",
            "estimate again from the episode, or use the tpcd that wrote it",
        )
    with fitting(path, "estimate again"):
        place = None if shape is not None else recorded_prior(card, Path(folder))
        misfit, step = MisfitField(**card["misfit"]), StepSettings(**card["step"])
        effects = effects_from_plain(card.get("effects", []), path)
        # JSON has no NaN: the filter `paper` estimates no evidence.
        evidence = {
            name: math.nan if card[name] is None else float(card[name])
            for name in ("log_evidence", "log_evidence_std")
        }
    if shape is None:
        assert place is not None
        shape = load_prior(place)
    data = Path(folder) / "belief.safetensors"
    try:
        content = data.read_bytes()
        tensors = load_tensors(content)
        values = {name: tensors[name].to(torch.float64) for name in (*_TENSORS, "low", "high")}
    except FileNotFoundError as error:
        raise RunError(data, "no such file", "estimate again") from error
    except (OSError, KeyError, ValueError, SafetensorError) as error:
        raise RunError(data, f"cannot be read ({error})", "estimate again") from error
    prior = ParameterPrior(shape, values.pop("low"), values.pop("high"), effects)
    found = sha256(content).hexdigest()
    if card.get("tensors_sha256", found) != found:
        fault = f"does not belong to its {path.name} (hash differs)"
        raise RunError(data, fault, "estimate again, with --resume if the run was stopped")
    if card.get("names") != list(prior.names) or values["vectors"].shape[-1] != prior.dimension:
        told = f"its names and effects are not those of the {prior.dimension} entries of theta"
        raise RunError(path, told, "estimate again")
    return Belief(
        prior=prior,
        misfit=misfit,
        step=step,
        log_evidence=evidence["log_evidence"],
        log_evidence_std=evidence["log_evidence_std"],
        **values,
    )
