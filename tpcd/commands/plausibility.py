"""Whether an episode can be explained under the priors at all, before any work is done, and whether
a run that is asked about it can be trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.belief.prior import make_prior
from tpcd.commands.estimation import STEPS_FILE, SUMMARY_FILE
from tpcd.commands.fit import unknown_warning
from tpcd.commands.unexplained import unexplained_warning
from tpcd.contact import scene_from_parameters, terrain_gaps
from tpcd.data.checks import NO_CONTACT, episode_findings
from tpcd.data.doubts import doubts_told
from tpcd.data.episode import Episode
from tpcd.data.noise import noise_findings
from tpcd.data.same_rows import row_marks, rows_among
from tpcd.data.table import row_name
from tpcd.effects.shape_change import ShapeChange
from tpcd.errors import EpisodeError
from tpcd.files import write_json
from tpcd.parameters import Parameters
from tpcd.planar import wrap_angle
from tpcd.records import fitting, read_entries
from tpcd.results import RESULTS_FILE
from tpcd.shape.protocol import Shape

DOUBTS_FILE, ROWS_FILE = "doubts.json", "learnt_rows.json"
DRAWS = 1000
"""Draws from the prior; what one draw in 100 explains is missed 4 times in 100,000."""
OUTLINE_ERROR = 5e-3
"""The start may be this deep inside [m]: real outlines differ from those of the prior."""
OUTLINE_DEVIATIONS = 3.0
"""So many standard deviations of the outline's error deeper once there is a belief,"""
LARGEST_MISFIT = 0.02
"""where that is less than this [m]: a larger one is made up for the start's sake."""
TERRAINS = ("floor", "wall")
LOAD_DEVIATIONS = 5.0
"""A row presses on a terrain where its force exceeds so many standard deviations of the sensor."""
TOO_DEEP, LONGEST_LEVER = 0.01, 0.3
"""The start may be this much deeper than a row that presses [m], and by so much more for each
radian that it is turned from it [m]."""


def check_start_pose(episode: Episode, shape: Shape, change: ShapeChange) -> None:
    """Refuse an episode whose start pose is inside floor or wall whatever the priors allow.

    Row 0 is the free start pose. Where no drawn outline, mount, floor and wall leaves it
    free, the poses are in another frame or the priors belong to another scene. `change` is what
    a model says of the object. Raises `EpisodeError` that says how deep the shallowest draw is.
    """
    _check_start_of_rows(episode)
    prior = make_prior(shape, change.bounds(episode.priors))
    draws = prior.sample(DRAWS, torch.Generator().manual_seed(0))
    remedy = "check the frame of the poses, or give floor_height and wall_position under priors"
    _refuse_inside(episode, shape, prior.to_parameters(draws), "draws from the priors", remedy)


def _check_start_of_rows(episode: Episode) -> None:
    """Refuse a free start that is far beyond where a later row at nearly its angle presses on floor
    or wall, whatever the shape is.

    On flat terrain the gap depends on the angle and on one coordinate alone. A force counts that no
    friction of the other terrain makes, which is less than that terrain's load.
    """
    turned = wrap_angle(episode.poses[1:, 2] - episode.poses[0, 2]).abs()
    x, z = (episode.poses[1:] - episode.poses[0])[:, :2].unbind(-1)
    push, lift = -episode.wrenches[1:, 0], episode.wrenches[1:, 1]
    for terrain, depth, load, other, noise in (
        ("floor", z, lift, push, episode.sensor_std[4]),
        ("wall", -x, push, lift, episode.sensor_std[3]),
    ):
        excess = depth - TOO_DEEP - LONGEST_LEVER * turned
        excess = torch.where(load > other.abs() + LOAD_DEVIATIONS * noise, excess, -torch.inf)
        row = int(excess.argmax())
        if excess[row] > 0:
            raise EpisodeError(
                episode.path or "episode",
                f"{_start_of(episode)} is {1e3 * float(depth[row]):.0f} mm inside the {terrain}"
                f" that row {row + 1} presses on at nearly the same angle, expected a pose free of"
                " contact",
                "measure the start again, or check the frame of the poses",
            )


def check_start_of(episode: Episode, belief: Belief) -> None:
    """Refuse an episode whose start pose is inside floor or wall for every particle of a belief,
    as `check_start_pose` does before there is one."""
    remedy = "predict episodes of the scene that the belief was learnt in, in the same frame"
    _refuse_inside(
        episode, belief.prior.shape, belief.parameters, "particles of the belief", remedy
    )


def contradicted_start(episode: Episode, belief: Belief) -> str:
    """A sentence where the start pose of the episode that a belief was learnt from is inside floor
    or wall by what the rows after it tell, also with what is believed of the outline's error; else
    empty.

    Effects move terrains, and with them nothing is said.
    """
    if belief.prior.effects:
        return ""
    some = belief.weights > 0
    parameters = belief.prior.parameters_of(belief.vectors[some])
    sd = belief.misfit_sd[some]
    explains = torch.where(sd < LARGEST_MISFIT, OUTLINE_DEVIATIONS * sd, 0.0)
    found = _inside(episode, belief.prior.shape, parameters, OUTLINE_ERROR + explains)
    if found is None:
        return ""
    depth, where = found
    return (
        f"{_start_of(episode)} is at least {depth:.0f} mm inside the {where} that the rows after it"
        " tell of; the estimate is not to be trusted: measure the start again, free of contact"
    )


def keep_doubts(episode: Episode, run: Path) -> None:
    """Write beside a belief, before there is one, what its episode was accepted in spite of."""
    told = doubts_told(episode.doubts, episode.path)
    if told:
        write_json(run / DOUBTS_FILE, {"episode_doubts": told})


def keep_rows(episodes: Sequence[Episode], run: Path) -> None:
    """Write beside a belief which rows it was learnt from."""
    write_json(run / ROWS_FILE, {"rows": [row_marks(episode) for episode in episodes]})


def run_warnings(run: Path, episodes: Sequence[Episode]) -> list[str]:
    """What is suspicious about predicting these episodes from a run."""
    found = []
    if (run / STEPS_FILE).is_file() and not (run / RESULTS_FILE).is_file():
        found.append(f"{run} was stopped before it was done; its belief is of the rows so far")
    for name, told_by in _TOLD_BY.items():
        if (run / name).is_file():
            remedy = "restore it, or estimate again"
            entries = read_entries(run / name, remedy)
            with fitting(run / name, remedy):
                found += [f"{run}{told}" for told in told_by(entries) if told]
    learnt, given = _rows_of(run), set()
    for episode in episodes:
        name = "" if episode.path is None else f"{episode.path.name}: "
        known, again = rows_among(episode, learnt), rows_among(episode, given)
        given |= set(row_marks(episode))
        of = f"of {len(episode) - 1} rows are"
        if known:
            told = f"what {run} was learnt from: they show how it fits, not how it predicts"
            found.append(f"{name}{len(known)} {of} {told}")
        if again:
            found.append(f"{name}{len(again)} {of} given more than once, and count as often")
        told = doubts_told(episode.doubts, episode.path)
        found += [told] if told else []
        odd = [*episode_findings(episode), *noise_findings(episode)]
        found += [f"{name}{each}" for each in map(str, odd) if each != NO_CONTACT]
    return found


def _rows_of(run: Path) -> set[str]:
    """Marks of the rows that a run was learnt from, where it tells."""
    path, remedy = run / ROWS_FILE, "restore it, or estimate again"
    if not path.is_file():
        return set()
    entries = read_entries(path, remedy)
    with fitting(path, remedy):
        return {str(mark) for marks in entries["rows"] for mark in marks}


def _told_by_doubts(doubts: Mapping[str, Any]) -> list[str]:
    return [f" was learnt from an episode with doubts: {doubts['episode_doubts']}"]


def _told_by_results(results: Mapping[str, Any]) -> list[str]:
    contradicted = results.get("contradicted")
    return [f" was learnt from {contradicted}"] if contradicted else []


def _told_by_summary(summary: Mapping[str, Any]) -> list[str]:
    unexplained, rows = (summary.get(key) for key in ("unexplained_rows", "rows"))
    told = unexplained_warning(unexplained, rows) if unexplained and rows else None
    unknown = unknown_warning(summary["fit"]) if "fit" in summary else None
    found = [f": of what it was learnt from, {told}"] if told else []
    return found + ([f": {unknown}"] if unknown else [])


_TOLD_BY = {
    DOUBTS_FILE: _told_by_doubts,
    RESULTS_FILE: _told_by_results,
    SUMMARY_FILE: _told_by_summary,
}
"""What the files of a run tell against it, each by its entries."""


def _refuse_inside(
    episode: Episode, shape: Shape, parameters: Parameters, what: str, remedy: str
) -> None:
    found = _inside(episode, shape, parameters, OUTLINE_ERROR)
    if found is None:
        return
    depth, where = found
    raise EpisodeError(
        episode.path or "episode",
        f"{_start_of(episode)} is at least {depth:.0f} mm inside the {where} for all of"
        f" {len(parameters.scale)} {what}, expected a pose free of contact",
        remedy,
    )


def _start_of(episode: Episode) -> str:
    x, z, angle = episode.poses[0].tolist()
    row = row_name(0, episode.path) if episode.path else "row 0"
    return f"{row}: the start pose ({x:.4g}, {z:.4g}, {angle:.4g})"


def _inside(
    episode: Episode, shape: Shape, parameters: Parameters, allowed: float | Tensor
) -> tuple[float, str] | None:
    """How deep [mm] the start pose is inside which terrain for the scene that it is least deep in;
    None where it is no deeper than allowed [m] for any."""
    with torch.no_grad():
        scene = scene_from_parameters(
            shape, replace(parameters, latent=parameters.latent.float())
        ).double()
        pose = episode.poses[0].expand(len(parameters.scale), 3)
        gaps = terrain_gaps(scene, pose)
    shallowest, terrain = gaps.amin(-1).min(-1)
    best = int(shallowest.argmax())
    if bool((shallowest > -allowed).any()):
        return None
    return -1e3 * float(shallowest[best]), TERRAINS[int(terrain[best])]
