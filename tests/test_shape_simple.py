"""What counts as one closed outline, and that the shipped priors draw nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tpcd.belief.belief import of_valid_shapes
from tpcd.belief.prior import make_prior
from tpcd.shape.checkpoint import load_prior
from tpcd.shape.deepsdf import DeepSDFNetwork
from tpcd.shape.simple import one_outline

SQUARE = 0.03 * np.array([[-1.0, -1], [0, -1], [1, -1], [1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0]])


def with_knot(size: float) -> np.ndarray:
    """The square with its last two corners moved so that a loop of about size^2 [m^2] forms."""
    loop = SQUARE[5:].copy()
    loop[0] = (-0.03 - size, 0.03)
    loop[1] = (-0.03 - size, 0.03 - size)
    loop[2] = (-0.03, 0.03 + size)
    return np.vstack((SQUARE[:5], loop))


def test_each_polygon_is_judged_by_itself() -> None:
    eight = SQUARE.copy()
    eight[[3, 7]] = eight[[7, 3]]
    broken = SQUARE.copy()
    broken[2, 0] = np.nan
    polygons = [SQUARE, SQUARE[::-1], eight, with_knot(0.001), with_knot(0.02)]
    polygons += [20 * SQUARE, 0.1 * SQUARE, broken, SQUARE]
    expected = [True, False, False, True, False, False, False, False, True]
    assert one_outline(np.stack(polygons)).tolist() == expected
    assert one_outline(np.zeros((0, 8, 2))).shape == (0,)


@pytest.mark.parametrize("name", ["ycb-rich", "ycb-rich-holdout"])
def test_latents_whose_outline_crosses_itself_are_flagged_and_not_drawn(name: str) -> None:
    shape = load_prior(name)
    draws = shape.sample_latent(4000, torch.Generator().manual_seed(0), checked=False)
    assert shape.density.valid(draws).all()
    outlines = shape.boundary_points(draws).numpy()
    valid = shape.valid(draws)
    assert valid.tolist() == one_outline(outlines).tolist()
    assert 0 < int((~valid).sum()) <= 0.005 * len(draws)
    assert shape.valid(draws.reshape(40, 100, -1)).flatten().equal(valid)
    bad = draws[~valid][0]
    assert not shape.valid(bad) and shape.valid(draws[valid][0])
    assert shape.valid(draws[:0]).shape == (0,)
    checked = shape.sample_latent(4000, torch.Generator().manual_seed(0))
    assert len(checked) == 4000 and shape.valid(checked).all()


def test_a_belief_gives_no_weight_to_such_an_outline() -> None:
    shape = load_prior("ycb-rich")
    draws = shape.sample_latent(4000, torch.Generator().manual_seed(0), checked=False)
    bad = draws[~shape.valid(draws)][:1]
    prior = make_prior(shape)
    vectors = prior.to_vector(prior.sample(4, torch.Generator().manual_seed(1)))
    weights = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    assert of_valid_shapes(prior, vectors, weights).equal(weights)
    vectors[1, : shape.latent_dim] = bad
    expected = torch.tensor([0.125, 0.0, 0.375, 0.5], dtype=torch.float64)
    torch.testing.assert_close(of_valid_shapes(prior, vectors, weights), expected)
    vectors[:, : shape.latent_dim] = bad
    with pytest.warns(UserWarning, match="none of the particles decodes"):
        assert of_valid_shapes(prior, vectors, weights).equal(weights)


def test_a_prior_of_which_nothing_is_valid_says_so() -> None:
    shape = load_prior("ycb21-z2")
    inside_out = DeepSDFNetwork(shape.network.architecture, len(shape.names))
    with torch.no_grad():
        for parameter in inside_out.parameters():
            parameter.zero_()
    empty = replace(shape, network=inside_out, _copies={})
    with pytest.raises(ValueError, match="5 of 5 latents still decode to no closed outline"):
        empty.sample_latent(5, torch.Generator().manual_seed(0))
