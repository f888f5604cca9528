"""Prior checkpoints: a folder with `weights.safetensors` and `card.json`.

The card says what the weights are (format version, architecture, names of the training
outlines, kind of density) and what they are worth (errors, provenance). Both files are
plain data: nothing is ever unpickled. `load_prior` answers every defect of a folder with
one line of `CheckpointError`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from tpcd.errors import CheckpointError
from tpcd.files import named
from tpcd.shape.deepsdf import Architecture, DeepSDFNetwork, DeepSDFShape
from tpcd.shape.density import LatentDensity, MaskDensity, MixtureDensity
from tpcd.shape.protocol import Misfit

FORMAT = "tpcd-prior"
FORMAT_VERSION = 2
WEIGHTS, CARD = "weights.safetensors", "card.json"
SHIPPED = Path(__file__).resolve().parents[2] / "checkpoints"
DENSITIES: dict[str, type[MaskDensity] | type[MixtureDensity]] = {
    "mask": MaskDensity,
    "mixture": MixtureDensity,
}
_MISFIT = {
    "misfit_sd_m": "sd",
    "misfit_log_std": "spread",
    "misfit_width_rad": "width",
    "misfit_grain": "grain",
    "misfit_roughness_per_rad": "roughness",
}
"""Keys of the card and the fields of `Misfit` that they hold."""
LARGEST_MISFIT = 0.5
"""An error of outlines beyond this was written in another unit [m]."""
_DENSITY = "density."
"""How names of a density's tensors begin."""
_REMEDY = "export it again with `python -m training.train`, or use a shipped prior"
_NEWER = "use the version of tpcd that it was made with, or a shipped prior"


def load_prior(path_or_name: str | Path) -> DeepSDFShape:
    """Load a prior from a folder, or a shipped one by its name such as 'ycb21-z2'.

    A name is looked up in ./checkpoints and in the repository's own checkpoints folder, and
    in `evaluation` below each. The answer is in evaluation mode, float32, on the CPU, and
    asks for no gradient of its weights.

    Raises:
        CheckpointError: no such folder, a file missing, unreadable or of another format
            version, tensors missing, of the wrong shape, or not finite.
    """
    folder = find_prior(path_or_name)
    card = _read_card(folder / CARD)
    tensors = _read_tensors(folder / WEIGHTS, str(card.get("weights_sha256", "")))
    try:
        architecture = _architecture(card["architecture"])
        names = _names(card["outlines"])
        density_kind = DENSITIES[card["density"]]
        misfit = _misfit(card)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(folder / CARD, f"lacks or garbles {error}", _REMEDY) from error
    _check_tensors(architecture, len(names), tensors, folder / WEIGHTS)
    network = DeepSDFNetwork(architecture, len(names))
    network.load_state_dict({name: tensors[name].float() for name in network.state_dict()})
    network.requires_grad_(False).eval()
    density = _density(density_kind, tensors, architecture.latent_dim, folder / WEIGHTS)
    return DeepSDFShape(network, density, names, misfit, card)


def save_prior(
    folder: str | Path,
    network: DeepSDFNetwork,
    density: MaskDensity | MixtureDensity,
    names: tuple[str, ...],
    misfit: Misfit,
    card: Mapping[str, Any],
) -> Path:
    """Write a prior to `folder`, replacing an older one at once; returns the folder.

    `card` holds what a reader should know beyond what loading needs; keys that loading
    needs are added here.
    """
    folder = Path(folder)
    kind = next(name for name, cls in DENSITIES.items() if isinstance(density, cls))
    tensors = {name: value.detach().float() for name, value in network.state_dict().items()}
    tensors |= {f"density.{name}": value for name, value in density.tensors().items()}
    weights = save({name: value.contiguous().cpu() for name, value in tensors.items()})
    own = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": folder.name,
        "architecture": dataclasses.asdict(network.architecture),
        "density": kind,
        **{key: getattr(misfit, name) for key, name in _MISFIT.items()},
        "outlines": list(names),
        "weights_sha256": hashlib.sha256(weights).hexdigest(),
    }
    # What belongs to these weights wins over what an older card said.
    full_card = own | dict(card) | own
    folder.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}-"))
    try:
        with named(folder / WEIGHTS):
            (staging / WEIGHTS).write_bytes(weights)
        with named(folder / CARD):
            (staging / CARD).write_text(json.dumps(full_card, indent=1) + "\n", encoding="utf-8")
        folder.mkdir(exist_ok=True)
        for name in (WEIGHTS, CARD):
            os.replace(staging / name, folder / name)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return folder


def find_prior(path_or_name: str | Path) -> Path:
    """Folder of a prior given by path or by name; CheckpointError if there is none."""
    for candidate in _places(path_or_name):
        return candidate
    given = Path(path_or_name)
    if given.exists() and (there := _what_is(given)):
        raise CheckpointError(given, *there)
    shipped = sorted(card.parent.name for card in SHIPPED.glob(f"*/{CARD}"))
    known = f"shipped priors are {', '.join(shipped)}" if shipped else "no priors are shipped here"
    raise CheckpointError(path_or_name, f"holds no prior ({CARD} and {WEIGHTS})", known)


def prior_record(path_or_name: str | Path, folder: Path) -> dict[str, str]:
    """What is written into a folder of the prior that it depends on, so that `recorded_prior` finds
    the same weights from wherever it is asked, and where both have been moved together."""
    place = find_prior(path_or_name).resolve()
    shipped = SHIPPED in place.parents
    return {
        "prior": place.name if shipped else str(place),
        "prior_from_here": Path(os.path.relpath(place, folder.resolve())).as_posix(),
        "prior_sha256": prior_hash(place),
    }


def recorded_prior(record: Mapping[str, Any], folder: Path) -> Path:
    """Folder of the prior that a `prior_record` in `folder` tells of; its weights decide.

    Raises `CheckpointError` where it is not to be found, or has other weights now, and `KeyError`
    where the record is none.
    """
    name, weights = str(record["prior"]), record["prior_sha256"]
    from_here = (
        [folder.resolve() / record["prior_from_here"]] if "prior_from_here" in record else []
    )
    found = [
        place
        for candidate in (name, *from_here, Path(name).name)
        for place in _places(candidate)
        if (place / WEIGHTS).is_file()
    ]
    for place in found:
        if prior_hash(place) == weights:
            return place
    places = ", ".join(dict.fromkeys(map(str, found or [name])))
    fault = f"has other weights than when {folder} was made"
    if not found:
        fault = f"holds no prior any more, but {folder} was made with it"
    raise CheckpointError(places, fault, "put the prior back, or estimate again")


def _places(path_or_name: str | Path) -> Iterator[Path]:
    """Folders with a prior that a path or a name may mean, the first one first."""
    given = Path(path_or_name)
    candidates = [given]
    if len(given.parts) == 1:
        roots = (Path("checkpoints"), SHIPPED)
        candidates += [root / sub / given for root in roots for sub in ("", "evaluation")]
    for candidate in candidates:
        if (candidate / CARD).is_file() or (candidate / WEIGHTS).is_file():
            yield candidate


def _what_is(given: Path) -> tuple[str, str] | None:
    """What a place is that holds no prior, and what to do; None where nothing is known of it."""
    if given.is_file():
        wanted = f"expected the folder of a prior, with {CARD} and {WEIGHTS}"
        if given.name in (CARD, WEIGHTS):
            return f"is a file, {wanted}", f"give {given.parent}"
        if given.suffix == ".ckpt":
            remedy = "give what the training exports; a stopped one goes on with --resume"
            return f"is a checkpoint of a training, {wanted}", remedy
        return f"is a file, {wanted}", _REMEDY
    inside = sorted(card.parent for card in given.glob(f"*/{CARD}"))
    if inside:
        return f"holds no prior itself, but {len(inside)} below it", f"give {inside[0]}"
    if any(given.glob("*.ckpt")):
        remedy = "go on with python -m training.train --resume"
        return "is the run of a training that has not written its prior", remedy
    return None


def prior_hash(path_or_name: str | Path) -> str:
    """SHA-256 of the weights of a prior given by path or by name."""
    return hashlib.sha256((find_prior(path_or_name) / WEIGHTS).read_bytes()).hexdigest()


def _read_card(path: Path) -> dict[str, Any]:
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CheckpointError(path, "is missing", _REMEDY) from error
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(path, f"is no readable JSON ({_line(error)})", _REMEDY) from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise CheckpointError(path, f"is not a card of format '{FORMAT}'", _REMEDY)
    version = card.get("format_version")
    if version != FORMAT_VERSION:
        newer = isinstance(version, int) and version > FORMAT_VERSION
        raise CheckpointError(
            path,
            f"has format version {version!r}, this program reads {FORMAT_VERSION}",
            _NEWER if newer else _REMEDY,
        )
    return card


def _architecture(sizes: object) -> Architecture:
    names = {field.name for field in dataclasses.fields(Architecture)}
    if not isinstance(sizes, dict) or set(sizes) != names:
        raise ValueError(f"'architecture' ({sizes!r:.80}), expected {', '.join(sorted(names))}")
    for name, size in sizes.items():
        if not isinstance(size, int) or isinstance(size, bool):
            raise ValueError(f"'architecture': {name} is {size!r}, expected a whole number")
    return Architecture(**sizes)


def _names(outlines: object) -> tuple[str, ...]:
    if not isinstance(outlines, list) or not outlines:
        raise ValueError(f"'outlines' ({outlines!r}), expected a list of names")
    strangers = [name for name in outlines if not isinstance(name, str) or not name]
    if strangers or len(set(outlines)) < len(outlines):
        what = f"the name {strangers[0]!r}" if strangers else "a name twice"
        raise ValueError(f"'outlines' with {what}")
    return tuple(outlines)


def _misfit(card: Mapping[str, Any]) -> Misfit:
    """All but the size may be missing: nobody measured them, and they take their defaults."""
    found = {name: card[key] for key, name in _MISFIT.items() if key in card}
    for key, name in _MISFIT.items():
        if isinstance(found.get(name), bool) or not isinstance(found.get(name, 0.0), (int, float)):
            raise ValueError(f"'{key}' ({found[name]!r}), expected a number")
    misfit = Misfit(**found | {"sd": card["misfit_sd_m"]})
    if misfit.sd > LARGEST_MISFIT:
        raise ValueError(f"'misfit_sd_m' ({misfit.sd}), expected at most {LARGEST_MISFIT} m")
    return misfit


def _read_tensors(path: Path, expected_hash: str) -> dict[str, Tensor]:
    try:
        data = path.read_bytes()
        tensors = load(data)
    except FileNotFoundError as error:
        raise CheckpointError(path, "is missing", _REMEDY) from error
    except (OSError, SafetensorError, ValueError, LookupError) as error:
        raise CheckpointError(path, f"is no safetensors file ({_line(error)})", _REMEDY) from error
    if hashlib.sha256(data).hexdigest() != expected_hash:
        raise CheckpointError(path, f"does not belong to its {CARD} (hash differs)", _REMEDY)
    return tensors


def _check_tensors(
    architecture: Architecture, codes: int, tensors: dict[str, Tensor], path: Path
) -> None:
    """Refuse tensors that are not those of a network of this size, or not finite."""
    with torch.device("meta"):  # shapes alone: a card may lie about them
        wanted = DeepSDFNetwork(architecture, codes).state_dict()
    strangers = sorted(set(tensors) - set(wanted))
    strangers = [name for name in strangers if not name.startswith(_DENSITY)]
    if strangers:
        raise CheckpointError(path, f"holds the tensor '{strangers[0]}' of other networks", _REMEDY)
    for name, target in wanted.items():
        value = tensors.get(name)
        if value is None:
            raise CheckpointError(path, f"lacks the tensor '{name}'", _REMEDY)
        if value.shape != target.shape:
            found, expected = tuple(value.shape), tuple(target.shape)
            raise CheckpointError(path, f"'{name}' has shape {found}, expected {expected}", _REMEDY)
        if not value.is_floating_point():
            kind = str(value.dtype).removeprefix("torch.")
            raise CheckpointError(path, f"'{name}' holds {kind}, expected float32", _REMEDY)
        if not value.float().isfinite().all():
            raise CheckpointError(path, f"'{name}' holds NaN or infinity", _REMEDY)


def _density(
    kind: type[MaskDensity] | type[MixtureDensity],
    tensors: dict[str, Tensor],
    latent_dim: int,
    path: Path,
) -> LatentDensity:
    own = {k.removeprefix(_DENSITY): v for k, v in tensors.items() if k.startswith(_DENSITY)}
    if not all(torch.isfinite(value.double()).all() for value in own.values()):
        raise CheckpointError(path, "has a density that is not finite", _REMEDY)
    try:
        density = kind.from_tensors(own)
        dims = density.means.shape[-1] if isinstance(density, MixtureDensity) else 2
    except (KeyError, ValueError, IndexError) as error:
        raise CheckpointError(path, f"lacks or garbles density tensor {error}", _REMEDY) from error
    if dims != latent_dim:
        raise CheckpointError(
            path, f"has a density of {dims} dimensions for {latent_dim} latents", _REMEDY
        )
    return density


def _line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
