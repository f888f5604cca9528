"""Find where simulation and measurement disagree, name the missing effect, and add it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tpcd.cli import check_numbers, check_resume, run

USUAL_OUT = Path("runs/diagnosis")


@dataclass(frozen=True)
class Diagnose:
    """Settings of the command."""

    episodes: tuple[Path, ...] = ()
    """Episodes of one set-up: NAME.csv, NAME.parquet or a folder with one episode."""
    out: Path = USUAL_OUT
    """Folder for the results; what --compare prints is kept where it is given."""
    prior: str = "ycb-rich"
    """Shape prior: a checkpoint folder, or the name of a shipped one."""
    model: Path | None = None
    """Model file with effects that are already known."""
    candidates: tuple[Path, ...] = ()
    """Python files with effects of your own to try too (tpcd/effects/README.md)."""
    fresh: tuple[Path, ...] = ()
    """Episodes of the same set-up that only measure the gap; without them blocks are held out."""
    seed: int = 0
    """Seed of all random numbers."""
    resume: bool = False
    """Go on with a run in the folder that was stopped."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    compare: tuple[Path, ...] = ()
    """Folders of earlier runs to put side by side instead."""

    def __post_init__(self) -> None:
        check_numbers(self)
        if bool(self.episodes) == bool(self.compare):
            raise ValueError("give episodes to diagnose, or runs to --compare")
        check_resume(self)


def diagnose_episodes(config: Diagnose) -> int:
    """Run the gap workflow and write its verdict, model, figures and report.

    Returns 0 where nothing is missing, 10 to 14 for the other verdicts in the order named,
    ambiguous, formula, unknown remains, not enough information.
    """
    import sys
    from dataclasses import replace
    from shlex import quote

    import torch
    from torch.utils.tensorboard import SummaryWriter

    from tpcd.belief.augmented import shape_change_of
    from tpcd.commands.diagnosing import (
        EXIT_CODES,
        compare_runs,
        fits_of,
        forget_fits,
        open_diagnosis,
        write_diagnosis,
    )
    from tpcd.commands.gap_rows import shown_data, shown_gaps, shown_share
    from tpcd.commands.work_line import WorkLine
    from tpcd.discrepancy.checks import read_data
    from tpcd.discrepancy.search import DiagnosisSettings, diagnose
    from tpcd.effects.formula import FORMULAS
    from tpcd.effects.model import Model, load_model
    from tpcd.effects.own import load_candidates
    from tpcd.effects.shape_change import UNCHANGED
    from tpcd.results import format_table, run_folder, write_results
    from tpcd.shape.checkpoint import load_prior

    if config.compare:
        table = compare_runs(config.compare)
        print(format_table(table))
        if config.out != USUAL_OUT:
            with run_folder(config.out, "scripts/diagnose.py", config, config.overwrite) as folder:
                write_results(folder, table)
        return 0
    torch.set_num_threads(1)
    data = read_data(config.episodes, config.fresh)
    for warning in data.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for note in data.notes:
        print(f"note: {note}")
    shape = load_prior(config.prior)
    model = Model() if config.model is None else load_model(config.model)
    settings = DiagnosisSettings(seed=config.seed, step=model.step, shape=model.shape)
    own = load_candidates(config.candidates, (*settings.catalogue, *FORMULAS))
    settings = replace(settings, catalogue=(*settings.catalogue, *own))
    with open_diagnosis(config, config.out, config.overwrite, config.resume) as folder:
        if data.answer is not None:
            found = data.answer
            print(f"verdict: not enough information: {found.sentence}")
        else:
            files = (*config.candidates, *(() if config.model is None else (config.model,)))
            with WorkLine() as line:
                memory = replace(fits_of(folder, files), watch=line.begin)
                found = diagnose(
                    data.episodes, shape, settings, data.fresh, model.effects, line.tell, memory
                )
        found = replace(found, notes=(*data.notes, *found.notes))
        if found.gap:
            where = shown_data(found)
            print(f"\none-step errors on {where}, with 90 % intervals")
            print(format_table(shown_gaps(found.gap)))
            print(f"closed of the excess over the noise, all channels: {shown_share(found)}")
        change = UNCHANGED
        if found.belief is not None:
            change = shape_change_of(found.belief, shape, data.episodes[0].priors)
        with SummaryWriter(folder / "tensorboard") as writer:
            gain = settings.least_gain
            write_diagnosis(found, data.episodes, gain, config.prior, folder, writer, change)
        write_results(folder, [vars(gap) for gap in found.gap], seeds=[config.seed])
        forget_fits(folder)
    print(f"\nreport in {config.out}/report.html, verdict in {config.out}/verdict.json", end="")
    if found.effects or change != UNCHANGED:
        print(
            f"; next: python scripts/estimate.py EPISODE --prior {quote(str(config.prior))}"
            f" --model {quote(str(config.out / 'model.yaml'))} --out RUN",
            end="",
        )
    print()
    return EXIT_CODES[found.verdict]


if __name__ == "__main__":
    run(diagnose_episodes, Diagnose, positional=("episodes",))
