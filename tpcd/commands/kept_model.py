"""The model that a run was asked to use, kept in its folder so that it goes on with no other."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from tpcd.effects.model import Model, effects_to_plain, load_model
from tpcd.errors import RunError
from tpcd.files import write_text
from tpcd.plain_yaml import read_yaml, to_yaml

MODEL_FILE = "model.yaml"


def model_of(path: Path | None) -> Model:
    """The model of a file, or the plain one without a file; raises `ModelError`."""
    return Model() if path is None else load_model(path)


def check_kept_model(model: Model, folder: Path) -> None:
    """Refuse to go on in a run that learnt something with another model; raises `RunError`.

    What a file of effects holds counts too.
    """
    if not (folder / "belief.json").is_file():
        return
    path = folder / MODEL_FILE
    before = read_yaml(path, RunError) if path.is_file() else _plain(Model())
    if before != _plain(model):
        raise RunError(folder, "holds a run whose model is not the same", "name a new folder")


def keep_model(model: Model, folder: Path, given: Path | None) -> None:
    """Write the model, as read from the file `given`, into a run's folder."""
    if given is not None:
        text = to_yaml(_plain(model))
        write_text(folder / MODEL_FILE, f"# as read from {given}\n{text}")


def _plain(model: Model) -> dict[str, Any]:
    effects = effects_to_plain(model.informed, fingerprints=True)
    plain = {"effects": effects, "step": asdict(model.step)}
    shape = model.shape.to_plain()
    return plain | {"shape": shape} if shape else plain
