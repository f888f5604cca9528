"""A few exploration moves with a mug, for tests of what estimates from them."""

from __future__ import annotations

import torch

from tpcd.data.episode import Episode
from tpcd.shape.builtin import builtin_outlines
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene


def short_episode(steps: int) -> Episode:
    """The measured rows of so many moves in the project's own simulator."""
    generator = torch.Generator().manual_seed(3)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    motion = make_motion("rich", scene, steps, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, steps, generator).measured
