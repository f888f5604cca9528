"""Give a prior a new outline head: `python -m training.reteach PRIOR RECIPE.yaml`.

The signed distance, the codes and the density stay as they are. The new head has the size that
the recipe asks for and learns where the level set lies, with the points of the old head to begin
at (`training.refine`). So outlines stay the same but for what the old head was off. A prior that
quotes the errors of another one (`unseen_from`) comes after that one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tpcd.cli import parse, run
from tpcd.errors import CheckpointError

HEAD = ("head_width", "head_depth", "head_frequency")


@dataclass(frozen=True)
class Reteaching:
    """Settings of the command."""

    prior: str
    """Checkpoint folder, or the name of a shipped prior; replaced once the new head is measured."""
    recipe: Path
    """YAML of a training; of it the size and first frequencies of the head count, and how the
    last stage learns: `refine_latents`, `refine_copies`, `refine_steps` (of one round), rates,
    `head_batch`, seed and threads."""
    out: Path | None = None
    """Folder for figures, TensorBoard and the new prior; by default runs/reteach-NAME."""


def reteach(config: Reteaching) -> None:
    """Train a new outline head for a prior, measure it, and renew weights and card."""
    import time
    from dataclasses import asdict, replace

    import torch

    from tpcd.shape.checkpoint import find_prior, load_prior, save_prior
    from training.measure import training_of
    from training.module import with_new_head
    from training.refine import fit_head, projected_outlines, with_codes
    from training.run import complete_card
    from training.train import Training

    recipe = parse(Training, [f"--config={config.recipe}"])
    optim = replace(recipe.optim, refine_rounds=1)
    folder = find_prior(config.prior)
    shape, (trained, outlines) = load_prior(folder), training_of(folder)
    if recipe.network.latent_dim != shape.latent_dim:
        raise CheckpointError(
            folder,
            f"has {shape.latent_dim} latents, the recipe {recipe.network.latent_dim}",
            "give the recipe of this prior",
        )
    if trained.unseen_from:
        load_prior(trained.unseen_from)
    torch.set_num_threads(optim.threads)
    began = time.process_time()
    generator = torch.Generator().manual_seed(optim.seed + 3)
    drawn = shape.sample_latent(optim.refine_latents, generator).float()
    latents = with_codes(drawn, shape.network, optim)
    targets = projected_outlines(shape.network, latents)
    network = with_new_head(shape.network, recipe.network, optim.seed)
    fit_head(network, latents, targets, optim, 0)
    network.eval().requires_grad_(False)

    card = dict(shape.card) | {
        "head": {
            "created": time.strftime("%Y-%m-%d"),
            "cpu_seconds": round(time.process_time() - began, 1),
            "network": {name: getattr(recipe.network, name) for name in HEAD},
            "optim": asdict(optim),
        }
    }
    out = config.out or Path("runs") / f"reteach-{folder.name}"
    staged = save_prior(out / folder.name, network, shape.density, shape.names, shape.misfit, card)
    new = load_prior(complete_card(staged, outlines, trained, out))
    save_prior(folder, new.network, new.density, new.names, new.misfit, new.card)
    print(f"{folder} has a new head; figures in {out}")


if __name__ == "__main__":
    run(reteach, Reteaching, positional=("prior", "recipe"))
