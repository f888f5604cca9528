"""An estimation into a run folder: belief, summary, progress, figures, TensorBoard.

The folder holds `belief.*` and `state.safetensors` (saved after every step), `steps.jsonl`
(one line for each step), `summary.json`, `figures/*.png` and a TensorBoard run in
`tensorboard`. With the state, a run that was stopped goes on where it was. At the end the belief is
found once more from many more draws: `belief.*`, `summary.json` and `closed` in the last line of
`steps.jsonl` are of that one, and the state stays that of the step.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tpcd.belief.belief import Belief, EstimationStep
from tpcd.belief.state import STATE_FILE, EstimatorState, save_state
from tpcd.belief.storage import load_belief, save_belief
from tpcd.commands.drawing import KnownTruth, draw_estimation
from tpcd.commands.fit import fit_line, learnt_fit, unknown_warning
from tpcd.commands.summary import prior_summary, summarise
from tpcd.commands.unexplained import unexplained_rows, unexplained_warning
from tpcd.data.episode import Episode
from tpcd.errors import RunError
from tpcd.exploration import Closing
from tpcd.files import named, write_json, write_text
from tpcd.records import fitting

STEPS_FILE, SUMMARY_FILE = "steps.jsonl", "summary.json"
FEW_DRAWS = 10
"""Effective sample size under which a belief is not to be trusted."""
HEAVY_TAIL = 0.7
"""Shape of the largest weights over which the belief is not to be trusted (see `pareto`)."""


def run_estimation(
    steps: Iterator[EstimationStep],
    episode: Episode,
    prior_name: str,
    folder: Path,
    truth: KnownTruth | None = None,
    show_progress: bool = True,
    state: EstimatorState | None = None,
    closing: Closing | None = None,
) -> Belief:
    """Draw the steps of an estimator to their end, saving as it goes; returns the belief.

    The steps up to the `state` of an earlier run in the folder are kept, and `steps` come after.
    """
    total = len(episode) - 1
    with EstimationRun(folder, prior_name, total, state, show_progress, closing) as run:
        for step in steps:
            run.add(step, episode)
        return run.finish(episode, truth)


class EstimationRun:
    """A run folder that is written step by step, while a progress bar tells how it goes."""

    def __init__(
        self,
        folder: Path,
        prior_name: str,
        total: int,
        state: EstimatorState | None = None,
        show_progress: bool = True,
        closing: Closing | None = None,
        belief: Belief | None = None,
    ) -> None:
        """The steps up to the `state` of an earlier run in the folder are kept; their belief is
        read back where it is not given."""
        done = 0 if state is None else state.index
        self.folder, self.state, self._closing = folder, state, closing
        self.history = _earlier_rows(folder / STEPS_FILE, done)
        self.belief = load_belief(folder) if done and belief is None else belief
        self._prior_name, self._done = prior_name, done
        self._total, self._show = total, show_progress

    def __enter__(self) -> EstimationRun:
        from torch.utils.tensorboard import SummaryWriter

        self._open = ExitStack()
        logs = SummaryWriter(self.folder / "tensorboard", purge_step=self._done + 1)
        self.writer = self._open.enter_context(logs)
        lines = (self.folder / STEPS_FILE).open("a", encoding="utf-8")
        self._lines = self._open.enter_context(lines)
        bar = tqdm(total=self._total, initial=self._done, unit="step", disable=not self._show)
        self.bar = self._open.enter_context(bar)
        self.bar.set_postfix_str("the first step also compiles, once on a machine")
        return self

    def __exit__(self, *error: object) -> None:
        self._open.close()

    def add(
        self,
        step: EstimationStep,
        episode: Episode,
        further: Mapping[str, Any] | None = None,
        lead: str = "",
    ) -> None:
        """Save a step. `further` goes into its line of `steps.jsonl` and, where it is a number, to
        TensorBoard; `lead` is shown first in the progress bar."""
        learnt = _learnt_most(self.belief, step.belief)
        self.belief, self.state = step.belief, step.state
        row = {**step_row(step, learnt), **(further or {})}
        self.history.append(row)
        with named(self.folder / STEPS_FILE):
            self._lines.write(json.dumps(row) + "\n")
            self._lines.flush()
        save_belief(step.belief, self.folder, self._prior_name)
        save_state(step.state, self.folder, episode, self._prior_name)
        _log_scalars(self.writer, row, step)
        for name, value in (further or {}).items():
            if isinstance(value, float):
                self.writer.add_scalar(f"exploration/{name}", value, step.index)
        self.bar.set_postfix_str(
            f"{lead}n_eff {row['effective_sample_size']:.0f}, learnt {learnt}, "
            f"{row['seconds']:.2f} s/step"
        )
        self.bar.update()

    def finish(self, episode: Episode, truth: KnownTruth | None = None) -> Belief:
        """Close the estimation, write the summary and the figures; returns the belief."""
        if self.belief is None or self.state is None:
            raise ValueError("the episode has no transitions, expected at least two rows")
        last = self._close(episode) or self.history[-1]
        total, unexplained = len(episode) - 1, unexplained_rows(episode, self.belief)
        fit = learnt_fit(episode, self.belief)
        told = {"rows": total, "unexplained_rows": unexplained, "fit": fit}
        write_json(self.folder / SUMMARY_FILE, {**summarise(self.belief), **told})
        self.bar.write(f"fit: {fit_line(fit)}; sides that nothing touched are the prior's guess")
        unknown = unknown_warning(fit)
        for warning in (few_draws_warning(last), unexplained_warning(unexplained, total), unknown):
            if warning is not None:
                self.bar.write(f"warning: {warning}", file=sys.stderr)
        rows = [*self.history[:-1], last]
        draw_estimation(
            self.belief,
            rows,
            episode,
            self.folder / "figures",
            self.writer,
            truth,
            closed="closed" in self.history[-1],
        )
        return self.belief

    def _close(self, episode: Episode) -> dict[str, Any] | None:
        """Find and save the last belief anew; its row, or None where that is not to be had."""
        if self._closing is None:
            return None
        assert self.state is not None
        self.bar.set_postfix_str("all data are in: drawing the last belief again, and more often")
        try:
            step = self._closing(episode, self.state)
        except ValueError as error:
            self.bar.write(f"warning: the last belief is as it was: {error}", file=sys.stderr)
            return None
        self.belief = step.belief
        row = step_row(step, self.history[-1]["learnt_most"])
        self.history[-1] = {**self.history[-1], "closed": row}
        self._lines.close()
        _write_rows(self.folder / STEPS_FILE, self.history)
        save_belief(step.belief, self.folder, self._prior_name)
        for name in ("effective_sample_size", "log_evidence", "seconds"):
            self.writer.add_scalar(f"closing/{name}", row[name], step.index)
        size = row["effective_sample_size"]
        self.bar.set_postfix_str(f"n_eff {size:.0f} of {step.info.draws}, {step.seconds:.1f} s")
        return row


def few_draws_warning(row: dict[str, Any]) -> str | None:
    """One line that says how few draws carry the belief after a step; None where enough do."""
    size, shape = row["effective_sample_size"], row["tail_shape"]
    if size >= FEW_DRAWS and (shape is None or shape <= HEAVY_TAIL):
        return None
    tail = (
        "" if shape is None else f" and a tail shape of {shape:.1f} (reliable up to {HEAVY_TAIL})"
    )
    return (
        f"few draws carry the belief after step {row['step']}, with an effective sample "
        f"size of {size:.0f}{tail}: intervals of theta may be too narrow; compare other seeds"
    )


def _earlier_rows(path: Path, done: int) -> list[dict[str, Any]]:
    """The first rows of the file; later ones, of a step that was not finished, are dropped, and
    so is how the run ended then."""
    remedy = "restore it, or estimate again"
    if done and not path.is_file():
        raise RunError(path, "no such file", remedy)
    with fitting(path, remedy):
        lines = path.read_text(encoding="utf-8").splitlines()[:done] if done else []
        rows = [dict(json.loads(line)) for line in lines]
        steps = [row["step"] for row in rows]
    if steps != list(range(1, done + 1)):
        told = f"holds other steps than the {done} that {STATE_FILE} has learnt from"
        raise RunError(path, told, remedy)
    for row in rows:
        row.pop("closed", None)
    _write_rows(path, rows)
    return rows


def _write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    write_text(path, "".join(json.dumps(row) + "\n" for row in rows))


def _learnt_most(before: Belief | None, now: Belief) -> str:
    """The parameter whose spread shrank most in this step."""
    names, std = now.prior.names, now.std()
    if before is None:
        _, low, high = prior_summary(now)
        reference = (high - low) / 3.29
    else:
        reference = before.std()
    return names[int((std / reference.clamp_min(1e-12)).argmin())]


def step_row(step: EstimationStep, learnt: str | None = None) -> dict[str, Any]:
    """What `steps.jsonl` holds of a step."""
    belief = step.belief
    return {
        "step": step.index,
        "seconds": step.seconds,
        "learnt_most": learnt,
        "effective_sample_size": float(step.info.effective_sample_size),
        "tail_shape": _known(step.info.tail_shape),
        "draws": step.info.draws,
        "distinct": step.info.distinct,
        "log_evidence": _known(belief.log_evidence),
        "log_evidence_std": _known(belief.log_evidence_std),
        "mean": belief.mean().tolist(),
        "low": belief.quantile(0.05).tolist(),
        "high": belief.quantile(0.95).tolist(),
    }


def _known(value: float) -> float | None:
    """The value, None where the estimator has none: JSON has no NaN."""
    return value if math.isfinite(value) else None


def _log_scalars(writer: Any, row: dict[str, Any], step: EstimationStep) -> None:
    writer.add_scalar("sampler/effective_sample_size", row["effective_sample_size"], step.index)
    writer.add_scalar("sampler/seconds", step.seconds, step.index)
    writer.add_scalar("sampler/distinct", row["distinct"], step.index)
    for name in ("tail_shape", "log_evidence"):
        if row[name] is not None:
            writer.add_scalar(f"sampler/{name}", row[name], step.index)
    for name, mean, std in zip(
        step.belief.prior.names, step.belief.mean(), step.belief.std(), strict=True
    ):
        writer.add_scalar(f"mean/{name}", float(mean), step.index)
        writer.add_scalar(f"std/{name}", float(std), step.index)
