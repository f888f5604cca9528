"""A checkpoint comes back as it was saved; a bad one gets one line, and nothing is unpickled."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tpcd.errors import CheckpointError
from tpcd.shape.checkpoint import CARD, WEIGHTS, load_prior, save_prior
from tpcd.shape.deepsdf import Architecture, DeepSDFNetwork
from tpcd.shape.density import MaskDensity
from tpcd.shape.protocol import Misfit

SMALL = Architecture(2, width=8, depth=1, points=16)
MISFIT = Misfit(0.002, 0.8, 0.2, 0.1, 5.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = DeepSDFNetwork(SMALL, 3)
    density = MaskDensity(torch.eye(4, dtype=torch.bool))
    return save_prior(tmp_path / "small", network, density, ("a", "b", "c"), MISFIT, {"note": "x"})


def test_a_saved_prior_comes_back_the_same(folder: Path, tmp_path: Path) -> None:
    first = load_prior(folder)
    second = load_prior(
        save_prior(tmp_path / "again", first.network, first.density, first.names, MISFIT, {})
    )
    latent = torch.linspace(-0.9, 0.9, 10, dtype=torch.float64).reshape(5, 2)
    torch.testing.assert_close(second.boundary_points(latent), first.boundary_points(latent))
    points = torch.rand(5, 4, 2, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(
        second.signed_distance(points, latent), first.signed_distance(points, latent)
    )
    assert torch.equal(second.valid(latent), first.valid(latent))
    assert (second.misfit, second.names) == (MISFIT, ("a", "b", "c"))
    assert first.card["note"] == "x"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again", "small"]


def _edit_card(folder: Path, **changes: object) -> None:
    card = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(card | changes))


def test_a_card_without_the_texture_of_the_misfit_takes_the_defaults(folder: Path) -> None:
    card = json.loads((folder / CARD).read_text())
    for key in ("misfit_log_std", "misfit_width_rad", "misfit_grain", "misfit_roughness_per_rad"):
        del card[key]
    (folder / CARD).write_text(json.dumps(card))
    assert load_prior(folder).misfit == Misfit(sd=MISFIT.sd)


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("key", ["misfit_sd_m", "misfit_width_rad", "misfit_roughness_per_rad"])
def test_a_misfit_without_meaning_is_refused(folder: Path, key: str, value: float) -> None:
    _edit_card(folder, **{key: value})
    with pytest.raises(CheckpointError, match="of the misfit is .*, expected a finite number"):
        load_prior(folder)


def test_weights_of_a_larger_network_are_refused(folder: Path) -> None:
    """Regression: layers that the card does not know were dropped without a word."""
    _edit_tensors(folder, lambda t: t.update({"decoder.4.weight": torch.zeros(8, 8)}))
    with pytest.raises(CheckpointError, match="holds the tensor 'decoder.4.weight'"):
        load_prior(folder)


def test_the_card_tells_the_size_of_the_weights_it_is_saved_with(folder: Path, tmp_path) -> None:
    small = load_prior(folder)
    deeper = Architecture(2, width=8, depth=3, points=16)
    network = DeepSDFNetwork(deeper, 3)
    saved = save_prior(tmp_path / "deeper", network, small.density, small.names, MISFIT, small.card)
    assert load_prior(saved).network.architecture == deeper


def _edit_tensors(folder: Path, change) -> None:
    tensors = load_file(folder / WEIGHTS)
    change(tensors)
    save_file(tensors, folder / WEIGHTS)
    import hashlib

    digest = hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()
    _edit_card(folder, weights_sha256=digest)


def _truncate(folder: Path) -> None:
    data = (folder / WEIGHTS).read_bytes()
    (folder / WEIGHTS).write_bytes(data[: len(data) // 2])


DEFECTS = {
    "format version 99": lambda f: _edit_card(f, format_version=99),
    "not a card": lambda f: (f / CARD).write_text("[]"),
    "no readable JSON": lambda f: (f / CARD).write_text("{"),
    "card.json: is missing": lambda f: (f / CARD).unlink(),
    "weights.safetensors: is missing": lambda f: (f / WEIGHTS).unlink(),
    "no safetensors file": _truncate,
    "hash differs": lambda f: _edit_card(f, weights_sha256="0"),
    "lacks or garbles 'outlines'": lambda f: (f / CARD).write_text(
        json.dumps({k: v for k, v in json.loads((f / CARD).read_text()).items() if k != "outlines"})
    ),
    "lacks or garbles 'pickle'": lambda f: _edit_card(f, density="pickle"),
    "lacks the tensor 'decoder.0.weight'": lambda f: _edit_tensors(
        f, lambda t: t.pop("decoder.0.weight")
    ),
    "holds NaN": lambda f: _edit_tensors(f, lambda t: t["decoder.0.bias"].fill_(torch.nan)),
    "'codes' has shape": lambda f: _edit_tensors(f, lambda t: t.update(codes=torch.zeros(9, 2))),
    "density tensor": lambda f: _edit_tensors(f, lambda t: t.pop("density.cells")),
}


@pytest.mark.parametrize("message", DEFECTS)
def test_a_defect_gets_one_line_that_names_it(folder: Path, message: str) -> None:
    DEFECTS[message](folder)
    with pytest.raises(CheckpointError) as caught:
        load_prior(folder)
    text = str(caught.value)
    assert message in text
    assert "\n" not in text
    assert str(folder) in text


def test_a_missing_prior_names_those_that_exist() -> None:
    with pytest.raises(CheckpointError, match="ycb21-z2"):
        load_prior("no-such-prior")


def test_loading_unpickles_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a pickle was read")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    monkeypatch.setattr(torch, "load", refuse)
    load_prior(folder)


def test_a_pickle_in_place_of_the_weights_is_refused(folder: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple:
            return (Path.touch, (folder / "boom",))

    (folder / WEIGHTS).write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(CheckpointError):
        load_prior(folder)
    assert not (folder / "boom").exists()
