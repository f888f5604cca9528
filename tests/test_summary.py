"""What is said of theta in plain numbers."""

from __future__ import annotations

from dataclasses import replace

import torch
from short_episode import short_episode

from tpcd.belief.belief import prior_belief
from tpcd.belief.settings import EstimatorSettings, SamplerSettings
from tpcd.commands.summary import summarise
from tpcd.shape.checkpoint import load_prior


def test_a_parameter_is_still_the_prior_only_where_it_is_still_there() -> None:
    settings = EstimatorSettings(sampler=SamplerSettings(particles=2000))
    generator = torch.Generator().manual_seed(0)
    belief = prior_belief(short_episode(2), load_prior("ycb21-z2"), generator, settings)
    belief = replace(belief, weights=torch.full_like(belief.weights, 1 / len(belief.weights)))
    before = summarise(belief)["parameters"]
    assert all(entry["still_the_prior"] for entry in before.values())
    i = belief.prior.names.index("friction")
    for moved in (belief.vectors[:, i] + 1.0, 0.3 + 0.1 * belief.vectors[:, i]):
        vectors = belief.vectors.clone()
        vectors[:, i] = moved
        after = summarise(replace(belief, vectors=vectors))["parameters"]
        assert not after["friction"]["still_the_prior"]
        assert after["floor_height"] == before["floor_height"]
