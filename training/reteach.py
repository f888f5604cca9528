"""Give a prior a new outline head: `python -m training.reteach PRIOR RECIPE.yaml`.

The signed distance, the codes and the density stay as they are. The new head has the size that
the recipe asks for and learns where the level set lies, with the points of the old head to begin
at (`training.refine`). So outlines stay the same but for what the old head was off.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tpcd.cli import run

HEAD = ("head_width", "head_depth", "head_frequency")


@dataclass(frozen=True)
class Reteaching:
    """Settings of the command."""

    prior: str
    """Checkpoint folder, or the name of a shipped prior; it is replaced."""
    recipe: Path
    """YAML of a training; of it the size and first frequencies of the head count, and how the
    last stage learns (`refine_latents`, `refine_steps`, rates, batch, seed and threads)."""
    out: Path | None = None
    """Folder for figures and TensorBoard; by default runs/reteach-NAME."""


def reteach(config: Reteaching) -> None:
    """Train a new outline head for a prior, measure it, and renew weights and card."""
    import time
    from dataclasses import asdict, replace

    import numpy as np
    import torch
    import yaml

    from tpcd.shape.checkpoint import find_prior, load_prior, save_prior
    from training.measure import config_of
    from training.module import with_new_head
    from training.outlines import training_outlines
    from training.refine import fit_head, projected_outlines, with_codes
    from training.run import complete_card

    recipe = config_of(yaml.safe_load(config.recipe.read_text(encoding="utf-8")))
    optim = recipe.optim
    torch.set_num_threads(optim.threads)
    folder = find_prior(config.prior)
    shape, began = load_prior(folder), time.process_time()
    drawn = shape.sample_latent(
        optim.refine_latents, torch.Generator().manual_seed(optim.seed + 3)
    ).float()
    latents = with_codes(drawn, shape.network)
    targets = projected_outlines(shape.network, latents)
    network = with_new_head(shape.network, recipe.network, optim.seed)
    fit_head(network, latents, targets, optim, 0)
    network.eval().requires_grad_(False)

    trained = config_of(dict(shape.card["configuration"]))
    head = {name: getattr(recipe.network, name) for name in HEAD}
    stage = {name: getattr(optim, name) for name in vars(optim) if name.startswith("refine_")}
    trained = replace(
        trained, network=replace(trained.network, **head), optim=replace(trained.optim, **stage)
    )
    card = dict(shape.card) | {
        "configuration": asdict(trained),
        "head_cpu_seconds": round(time.process_time() - began, 1),
    }
    save_prior(folder, network, shape.density, shape.names, shape.misfit, card)
    outlines = training_outlines(trained.data, np.random.default_rng(trained.optim.seed))
    out = config.out or Path("runs") / f"reteach-{folder.name}"
    out.mkdir(parents=True, exist_ok=True)
    complete_card(folder, outlines, trained, out)
    print(f"{folder} has a new head; figures in {out}")


if __name__ == "__main__":
    run(reteach, Reteaching, positional=("prior", "recipe"))
