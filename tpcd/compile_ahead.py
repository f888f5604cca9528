"""Compile the loops ahead of their first use: `python -m tpcd.compile_ahead`.

numba keeps compiled loops beside the sources, and makes them again where these have changed. Else
the first command that needs them waits for that, in the middle of its work.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from tpcd.cli import run

_MODELS = ("floor_compliance", "floor_height ~ wave")
"""Effects that need loops of their own: of terrain that yields, and of an uneven floor."""


def compile_loops() -> None:
    """Simulate two steps of contact and learn from them, by all loops that estimation needs, on
    rigid terrain, on terrain that yields and on an uneven floor."""
    import torch

    from tpcd.belief import EstimatorSettings, SamplerSettings, estimate
    from tpcd.effects.catalogue import find_effect
    from tpcd.predict import ContactPredictor
    from tpcd.shape.builtin import builtin_outlines
    from tpcd.shape.polygon import PolygonShape
    from tpcd.truth.make import make_truth
    from tpcd.truth.recording import make_motion, record
    from tpcd.truth.scene import draw_scene

    generator = torch.Generator().manual_seed(0)
    outline = builtin_outlines()["mug"]
    scene = draw_scene("mug", outline.vertices, generator)
    motion = make_motion("rich", scene, 2, generator)
    episode = record(make_truth(scene, "quasistatic"), scene, motion, 2, generator).measured
    for effects in ((), *((find_effect(name),) for name in _MODELS)):
        settings = EstimatorSettings(sampler=SamplerSettings(particles=20), effects=effects)
        *_, last = estimate(episode, PolygonShape(outline), generator, settings)
        ContactPredictor(last.belief).predict(
            episode.poses[:-1], episode.commands[1:], previous=episode.commands[:-1]
        )


@dataclass(frozen=True)
class CompileAhead:
    """There is nothing to set."""


def compile_ahead(config: CompileAhead) -> None:
    """Compile what is not compiled yet, and say how long that took."""
    began = time.perf_counter()
    compile_loops()
    print(f"the compiled loops are ready ({time.perf_counter() - began:.0f} s)")


if __name__ == "__main__":
    run(compile_ahead, CompileAhead)
