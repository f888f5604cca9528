"""The order of theta, its names and its flat form."""

from __future__ import annotations

import pytest
import torch

from tpcd.parameters import (
    DEFAULT_BOUNDS,
    SCENE_NAMES,
    Parameters,
    parameter_names,
    parameter_units,
)


@pytest.mark.parametrize("latent_dim", [0, 1, 2, 5])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3), (0,)])
def test_the_flat_form_keeps_everything_in_order(latent_dim, batch):
    vector = torch.randn(*batch, latent_dim + 7, generator=torch.Generator().manual_seed(0))
    parameters = Parameters.from_vector(vector)
    assert parameters.latent_dim == latent_dim
    assert torch.equal(parameters.to_vector(), vector)
    names = parameter_names(latent_dim)
    assert torch.equal(parameters.friction, vector[..., names.index("friction")])
    assert torch.equal(parameters.mount[..., 2], vector[..., names.index("mount_phi")])
    assert torch.equal(parameters.wall_position, vector[..., -1])


def test_every_entry_has_a_name_a_unit_and_bounds():
    assert len(parameter_names(3)) == len(parameter_units(3)) == 10
    assert tuple(DEFAULT_BOUNDS) == SCENE_NAMES
    assert all(low < high for low, high in DEFAULT_BOUNDS.values())


def test_a_vector_too_short_for_the_scene_is_refused():
    with pytest.raises(ValueError, match="theta has 6 entries, expected at least 7"):
        Parameters.from_vector(torch.zeros(6))
