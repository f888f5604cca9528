"""Estimate object, mount, friction, floor and wall from one recorded episode."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from tpcd.cli import check_numbers, check_resume, run


@dataclass(frozen=True)
class Estimate:
    """Settings of the command; lengths in metres."""

    episode: Path
    """Episode to learn from: NAME.csv, NAME.parquet or a folder with one episode."""
    prior: str
    """Shape prior: a checkpoint folder, or the name of a shipped one such as ycb-rich."""
    out: Path
    """Folder for the results; a stopped run in it goes on with --resume."""
    model: Path | None = None
    """Model file with effects to estimate too, such as diagnose writes (tpcd/effects/README.md)."""
    estimator: Literal["default", "paper"] = "default"
    """`paper` is the particle filter of arXiv 2409.17470 for comparison."""
    particles: int = 700
    """Particles of the belief (the filter `paper` has its own number)."""
    misfit: float | None = None
    """Median of the outline error's standard deviation [m]; by default the prior's own figure, or
    as many times that as --model says."""
    solver: Literal["native", "qpth"] = "native"
    """Backend of the contact problems; `qpth` is there to compare with and takes some hundred times
    as long."""
    seed: int = 0
    """Seed of all random numbers."""
    resume: bool = False
    """Go on with a run in the folder that was stopped."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        above, most = {"misfit": 0.0}, {"misfit": 0.05}
        check_numbers(self, least={"particles": 16}, above=above, most=most)
        if self.model is not None and self.estimator == "paper":
            raise ValueError("the estimator paper has a model of its own; leave --model out")
        check_resume(self)


def estimate_episode(config: Estimate) -> None:
    """Estimate the contact model from an episode and write the belief to a run folder."""
    import sys
    from shlex import quote

    import torch
    from torch.utils.tensorboard import SummaryWriter

    from tpcd.belief import EstimatorSettings, SamplerSettings
    from tpcd.belief.paper import PAPER_STEP, PaperSettings
    from tpcd.belief.state import STATE_FILE, load_state
    from tpcd.commands.estimation import run_estimation
    from tpcd.commands.kept_model import check_kept_model, keep_model, model_of
    from tpcd.commands.plausibility import (
        check_start_pose,
        contradicted_start,
        keep_doubts,
        keep_rows,
    )
    from tpcd.commands.summary import parameter_rows
    from tpcd.data import check_episode, read_episode
    from tpcd.data.checks import check_units
    from tpcd.errors import EpisodeError, RunError
    from tpcd.exploration import Estimator
    from tpcd.results import (
        RESULTS_FILE,
        format_table,
        resumed_run,
        run_folder,
        write_results,
    )
    from tpcd.shape.checkpoint import load_prior

    # Small tensor operations are fastest on one thread; the compiled loops have their own.
    torch.set_num_threads(1)
    episode = read_episode(config.episode)
    model = model_of(config.model)
    shape = load_prior(config.prior)
    check_units(episode)
    check_start_pose(episode, shape, model.shape)
    for warning in check_episode(episode, effects=bool(model.effects)):
        print(f"warning: {warning}", file=sys.stderr)
    if config.resume:
        check_kept_model(model, config.out)
        if (config.out / RESULTS_FILE).is_file():
            raise RunError(config.out, "is finished", "leave out --resume and name a new folder")
        # The state knows its data and the run its model, so files may have been moved.
        free = ("episode", "model", "out")
        opened = resumed_run(config.out, config, free)
    else:
        opened = run_folder(
            config.out, "scripts/estimate.py", config, config.overwrite, resumable=STATE_FILE
        )
    with opened as folder:
        keep_model(model, folder, config.model)
        keep_doubts(episode, folder)
        keep_rows([episode], folder)
        state = load_state(folder, episode, config.prior)
        settings = EstimatorSettings(
            sampler=SamplerSettings(particles=config.particles),
            step=replace(model.step, solver=config.solver),
            misfit_sd=config.misfit,
            effects=model.informed,
            shape=model.shape,
        )
        filtered = PaperSettings(step=replace(PAPER_STEP, solver=config.solver))
        estimator = Estimator(shape, config.estimator, settings, filtered)
        steps = estimator.steps(episode, torch.Generator().manual_seed(config.seed), state)
        belief = run_estimation(
            steps, episode, config.prior, folder, state=state, closing=estimator.closing
        )
        table = parameter_rows(belief)
        text = format_table(table)
        print(text)
        with SummaryWriter(folder / "tensorboard") as writer:
            writer.add_text("table", f"```\n{text}\n```")
        # The paper's filter does not know that the start is free.
        paper = config.estimator == "paper"
        contradicted = "" if paper else contradicted_start(episode, belief)
        write_results(folder, table, seeds=[config.seed], contradicted=contradicted)
    if contradicted:
        raise EpisodeError(config.episode, contradicted, f"what was found is in {config.out}")
    print(
        f"\nresults in {config.out}; next: python scripts/predict.py {quote(str(config.out))}"
        " EPISODE --out FILE.csv"
    )


if __name__ == "__main__":
    run(estimate_episode, Estimate, positional=("episode",))
