"""Simulation-based calibration of an estimator on the contact model (Talts et al. 2018).

Each run draws theta from the prior, an episode given theta, and asks where theta lies in the
posterior: its place u = P(entry < true entry | data), by as many draws as the belief is worth, is
uniform when the posterior is right.
`eval/drawn.py` says how exactly the episodes come from the likelihood's own model. So what is
asked is whether likelihood and sampler are right.
With `--estimator paper` the data are the same, while that filter assumes another noise: its
ranks show what this costs. With `--estimator steps` the default's last belief is not drawn once
more: that is what the next move is chosen by. With `--estimator likelihood` there is no estimator:
each true entry is placed given the true values of all others (`eval/conditional.py`), which asks
about the default likelihood alone.

python -m eval.calibration --runs 200 --steps 10 --out runs/calibration
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from eval.lines import append_lines, read_lines, write_line
from eval.opened import opened_run
from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tpcd.shape.protocol import Shape

COMMAND = "python -m eval.calibration"
RUNS_FILE = "runs.jsonl"
BINS = 10


@dataclass(frozen=True)
class Calibration:
    """What to calibrate; a folder with runs of the same settings is continued."""

    out: Path
    """Folder for results.json, the figure, TensorBoard and one JSON line for each run."""
    runs: int = 200
    """Runs in total, those already in the folder included."""
    steps: int = 10
    """Transitions of each episode."""
    estimator: Literal["default", "steps", "paper", "likelihood"] = "default"
    """Whose posterior to check; with "steps" the default's quick one between moves, with
    "likelihood" that of each entry given all others."""
    prior: str = "ycb21-z2"
    """Shape prior: a folder or a shipped name."""
    quick: bool = False
    """A built-in outline instead of the shape prior, and few particles."""
    misfit: float | None = None
    """Median of the outline error's standard deviation [m]; by default the prior's own figure."""
    particles: int = 0
    """Particles; 0 takes 700 (default) or 5000 (paper), with --quick 300 or 1000."""
    seed: int = 0
    """Run r takes seed + r."""

    def __post_init__(self) -> None:
        above = {"misfit": 0.0}
        check_numbers(self, least={"runs": 1, "steps": 1, "particles": 0}, above=above)


def calibrate(config: Calibration) -> None:
    """Check that posteriors cover what they say, over many simulated episodes."""
    import torch
    from torch.utils.tensorboard import SummaryWriter
    from tqdm import tqdm

    from tpcd.belief.prior import make_prior
    from tpcd.figures import save_figure
    from tpcd.results import CONFIG_FILE, format_table, write_results

    torch.set_num_threads(1)
    shape, earlier = _shape(config), (config.out / CONFIG_FILE).is_file()
    with opened_run(config, COMMAND, ("out", "runs"), resume=earlier) as folder:
        lines_path = folder / RUNS_FILE
        done = {int(line["seed"]): line for line in read_lines(lines_path)}
        missing = [config.seed + r for r in range(config.runs) if config.seed + r not in done]
        with append_lines(lines_path) as file:
            for seed in tqdm(missing, desc="calibration", unit="run"):
                done[seed] = {"seed": seed, **_one_run(config, shape, seed)}
                write_line(file, done[seed])
        found = [line for line in done.values() if "place" in line]
        places = [line["place"] for line in found]
        failed = len(done) - len(places)
        if not places:
            raise ValueError(f"all {failed} runs failed; see {lines_path}")
        names = make_prior(shape).names
        if config.estimator != "paper":
            names = (*names, "misfit_sd")
        table = coverage_table(places, names)
        print(format_table(table))
        by_misfit = []
        if config.estimator == "likelihood":
            # Not the misfit's own place, which its size decides.
            theta = [place[:-1] for place in places]
            by_misfit = coverage_by_misfit(theta, [line["misfit_score"] for line in found])
        if by_misfit:
            print(format_table(by_misfit))
        print(f"{len(places)} runs, {failed} failed; limits hold 95 % of calibrated estimators")
        where = "given all others" if config.estimator == "likelihood" else "in the posterior"
        figure = rank_histograms(places, names, where)
        with SummaryWriter(str(folder / "tensorboard")) as writer:
            save_figure(figure, folder / "figures", "ranks", writer)
            writer.add_text("table", "```\n" + format_table(table) + "\n```")
            for row in table:
                writer.add_scalar(f"coverage_90/{row['parameter']}", row["inside_90"])
                writer.add_scalar(f"coverage_50/{row['parameter']}", row["inside_50"])
        more = {"by_misfit": by_misfit} if by_misfit else {}
        write_results(folder, table, seeds=sorted(done), runs=len(places), failed=failed, **more)


def coverage_table(places: Sequence[Sequence[float]], names: Sequence[str]) -> list[dict[str, Any]]:
    """Coverage of central 50 and 90 % intervals, with 95 % binomial limits, and the p-value of
    a chi-square test of uniform ranks, for each parameter."""
    import numpy as np
    from scipy.stats import binom, chisquare

    place = np.asarray(places)
    count = len(place)
    table = []
    for i, name in enumerate(names):
        row: dict[str, Any] = {"parameter": name}
        for level in (0.5, 0.9):
            inside = float((np.abs(place[:, i] - 0.5) <= level / 2).mean())
            low, high = binom.ppf([0.025, 0.975], count, level) / count
            percent = f"{100 * level:.0f}"
            row |= {f"inside_{percent}": inside, f"low_{percent}": low, f"high_{percent}": high}
            row[f"within_{percent}"] = bool(low <= inside <= high)
        counts, _ = np.histogram(place[:, i], BINS, (0.0, 1.0))
        row["p_uniform"] = float(chisquare(counts).pvalue)
        table.append(row)
    return table


def coverage_by_misfit(
    places: Sequence[Sequence[float]], scores: Sequence[float]
) -> list[dict[str, Any]]:
    """Coverage of central 50 and 90 % intervals, over all entries, in runs whose true misfit is
    small, usual and large (below, within and above one standard deviation of its logarithm's
    prior), with the standard error over runs. Calibrated places need not be uniform within such
    a class unless they are places given the misfit. Classes of fewer than two runs are left out.
    """
    import numpy as np

    place, score = np.asarray(places), np.asarray(scores)
    classes = {"small": score < -1, "usual": np.abs(score) <= 1, "large": score > 1}
    table = []
    for name, chosen in classes.items():
        row: dict[str, Any] = {"true_misfit": name, "runs": int(chosen.sum())}
        if row["runs"] < 2:
            continue
        for level in (0.5, 0.9):
            inside = (np.abs(place[chosen] - 0.5) <= level / 2).mean(-1)
            percent = f"{100 * level:.0f}"
            row[f"inside_{percent}"] = float(inside.mean())
            row[f"se_{percent}"] = float(inside.std(ddof=1) / len(inside) ** 0.5)
        table.append(row)
    return table


def rank_histograms(
    places: Sequence[Sequence[float]], names: Sequence[str], where: str = "in the posterior"
) -> Figure:
    """One histogram for each parameter, with the band that holds 95 % of calibrated counts."""
    import numpy as np
    from scipy.stats import binom

    from tpcd.figures.style import BELIEF, panels, title

    place = np.asarray(places)
    low, high = binom.ppf([0.025, 0.975], len(place), 1 / BINS)
    columns = 3
    figure, axes = panels(-(-len(names) // columns), columns, 2.9, 2.0)
    for i, (panel, name) in enumerate(zip(axes, names, strict=False)):
        panel.axhspan(float(low), float(high), color="0.85", linewidth=0)
        panel.hist(place[:, i], BINS, range=(0.0, 1.0), color=BELIEF, alpha=0.8)
        panel.set_xlim(0, 1)
        title(panel, name.replace("_", " "))
        panel.set_xlabel(f"place of the truth {where} [–]")
    for panel in axes[len(names) :]:
        panel.remove()
    return figure


def _one_run(config: Calibration, shape: Shape, seed: int) -> dict[str, Any]:
    """Places of the true entries in their posterior, or why there are none."""
    import torch

    from eval.conditional import conditional_places
    from eval.drawn import draw_episode
    from tpcd.belief.belief import estimate, target_of
    from tpcd.belief.history import history_of
    from tpcd.belief.paper import PaperSettings
    from tpcd.belief.prior import make_prior
    from tpcd.belief.resampling import weighted_place
    from tpcd.belief.settings import EstimatorSettings, SamplerSettings
    from tpcd.exploration import Estimator

    few = (300, 1000) if config.quick else (700, 5000)
    particles = config.particles or few[config.estimator == "paper"]
    settings = EstimatorSettings(
        sampler=SamplerSettings(particles=particles), misfit_sd=config.misfit
    )
    generator = torch.Generator().manual_seed(seed)
    prior = make_prior(shape)
    try:
        truth, episode = draw_episode(prior, settings, config.steps, generator)
        if config.estimator == "likelihood":
            target = target_of(episode, shape, settings).given(history_of(episode))
            misfit = (truth[-1:] / target.misfit.sd).log() / target.misfit.spread
            score = torch.cat((prior.to_score(truth[:-1]), misfit))
            place = conditional_places(target, score)
            return {"place": place.tolist(), "misfit_score": float(misfit)}
        if config.estimator == "steps":
            *_, last = estimate(episode, shape, generator, settings)
        else:
            paper = PaperSettings(particles=particles)
            last = Estimator(shape, config.estimator, settings, paper).learn(episode, generator)
        belief = last.belief
    except ValueError as error:
        return {"failed": str(error)}
    found = torch.cat((belief.vectors, belief.misfit_sd[:, None]), dim=-1)
    if config.estimator == "paper":
        found, truth = belief.vectors, truth[:-1]
    worth = belief.effective_sample_size
    place = weighted_place(found, belief.weights, truth, worth)
    return {"place": place.tolist(), "effective_sample_size": worth}


def _shape(config: Calibration) -> Shape:
    from tpcd.shape.builtin import builtin_outlines
    from tpcd.shape.checkpoint import load_prior
    from tpcd.shape.polygon import PolygonShape

    if config.quick:
        return PolygonShape(builtin_outlines()["mug"])
    return load_prior(config.prior)


if __name__ == "__main__":
    run(calibrate, Calibration)
