"""Predict the rows of episodes from a belief, and score the predictions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tpcd.cli import check_numbers, run


@dataclass(frozen=True)
class Predict:
    """Settings of the command."""

    run: Path
    """Run folder that scripts/estimate.py wrote."""
    episodes: tuple[Path, ...]
    """Episodes to predict, one or more."""
    out: Path
    """File for the predictions, .csv or .parquet: step, then x_mean, x_sd, x_q05, x_q95 and the
    same of z, phi, F_x, F_z, tau; of several episodes a column episode (0, 1, ...) comes first.
    Scores, and how the recording fits the belief, go into FILE.json."""
    model: Path | None = None
    """A model.yaml whose effects join the belief, drawn from what it says was found."""
    rollout: bool = False
    """Start at row 0 and feed on own predictions, instead of on every measured pose."""
    of: Literal["measured", "true"] = "measured"
    """Intervals of what the sensors read (episode's noise included) or of what is true, compared
    with the truth where simulate.py left it beside the episodes."""
    particles: int = 400
    """Particles used for prediction."""
    seed: int = 0
    """Seed of the random numbers of rollouts and of the model's effects."""
    overwrite: bool = False
    """Replace an existing file."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"particles": 1})


def predict_episodes(config: Predict) -> None:
    """Predict every row of the episodes from the row before and print error and coverage."""
    import sys

    import torch

    from tpcd.belief.augmented import with_model
    from tpcd.belief.storage import load_belief
    from tpcd.commands.fit import fit_line, fit_of, foreign_warning
    from tpcd.commands.kept_model import model_of
    from tpcd.commands.plausibility import check_start_of, run_warnings
    from tpcd.commands.prediction import (
        PredictedRows,
        joined,
        measured_rows,
        predict_rows,
        rollout_rows,
        score_rows,
        write_prediction,
    )
    from tpcd.data import read_episode
    from tpcd.data.files import TABLE_SUFFIXES
    from tpcd.effects.shape_change import UNCHANGED
    from tpcd.errors import RunError
    from tpcd.files import write_json
    from tpcd.predict import ContactPredictor
    from tpcd.results import format_table
    from tpcd.targets import check_target
    from tpcd.truth.recording import check_truth, has_truth, read_truth

    # Small tensor operations are fastest on one thread; the compiled loops have their own.
    torch.set_num_threads(1)
    episodes = [read_episode(path) for path in config.episodes]
    read = [episode.path for episode in episodes if episode.path is not None]
    results = config.out.with_name(f"{config.out.name}.json")
    for target in (config.out, results):
        check_target(target, config.overwrite, read)
    if config.out.suffix not in TABLE_SUFFIXES:
        raise RunError(config.out, "is no .csv or .parquet", "choose a name that ends so")
    model = model_of(config.model)
    belief = load_belief(config.run)
    for path, episode in zip(config.episodes, episodes, strict=True):
        if not torch.allclose(episode.stiffness, belief.stiffness):
            raise RunError(
                path,
                f"stiffness {episode.stiffness.tolist()} is not that of the belief "
                f"{belief.stiffness.tolist()}",
                "predict episodes recorded with the same controller",
            )
        check_start_of(episode, belief)
    for warning in run_warnings(config.run, episodes):
        print(f"warning: {warning}", file=sys.stderr)
    generator = torch.Generator().manual_seed(config.seed)
    if config.model is not None:
        try:
            belief = with_model(belief, model, generator)
        except ValueError as error:
            raise RunError(config.run, str(error), f"leave {config.model} out") from error
        for effect in model.effects:
            source = "what was found" if effect.name in model.found else "its prior"
            print(f"{effect.name} is drawn from {source} in {config.model}")
        if model.shape != UNCHANGED:
            print(f"the belief keeps its shape; the one in {config.model} is for estimates")
    predictor = ContactPredictor(belief, config.particles)
    predicted: list[PredictedRows] = []
    known = config.of == "true" and all(map(has_truth, read))
    compared = [read_truth(path)[0] for path in read] if known else episodes
    for episode, rows in zip(episodes, compared, strict=True):
        check_truth(episode, rows)
    for episode, rows in zip(episodes, compared, strict=True):
        if config.rollout:
            predicted.append(rollout_rows(predictor, episode, generator, config.of, rows))
        else:
            predicted.append(predict_rows(predictor, episode, config.of, rows))
    write_prediction(predicted, config.out)
    # What fits is told of single steps to what the sensors read, whatever else was asked for.
    plain = compared is episodes and not config.rollout and config.of == "measured"
    steps = predicted if plain else [predict_rows(predictor, episode) for episode in episodes]
    fits = [
        fit_of(step, measured_rows(episode)[1:], episode.sensor_std)
        for step, episode in zip(steps, episodes, strict=True)
    ]
    foreign = [foreign_warning(fit) for fit in fits]
    found = torch.cat([measured_rows(rows)[1:] for rows in compared])
    kind = "rollout" if config.rollout else "one-step"
    against = "rows without noise (.truth.csv)" if known else "rows as measured"
    print(f"{kind} predictions of {len(found)} rows, against the {against}")
    scores = score_rows(joined(predicted), found)
    print(format_table(scores))
    for path, fit, warning in zip(read, fits, foreign, strict=True):
        name = f"{path.name}, " if len(read) > 1 else ""
        print(f"{name}single steps: {fit_line(fit)}")
        if warning:
            print(f"warning: {path.name}: {warning}", file=sys.stderr)
    write_json(results, {"scores": scores, "kind": kind, "fits": fits, "warnings": foreign})
    if config.of == "true" and not known:
        print("intervals leave sensor noise out, so noisy rows fall outside of them more often")
    print(f"predictions in {config.out}, scores and fit in {results}")


if __name__ == "__main__":
    run(predict_episodes, Predict, positional=("run", "episodes"))
