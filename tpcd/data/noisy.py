"""Reading episodes whose YAML may not say how noisy their sensors are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tpcd.data.episode import Episode
from tpcd.data.files import locate, read_rows
from tpcd.data.header import Header, read_header
from tpcd.data.noise import check_noise, estimate_noise
from tpcd.errors import EpisodeError

NEEDED_MOTION = (
    "repeat commands in free space and in contact, at least 4 times in all (as the motions of"
    " scripts/plan_diagnosis.py do), or hold the arm still without contact for about 10 s and give"
    " sensor_std: the standard deviation of x, z [m], phi [rad], F_x, F_z [N], tau [N·m]"
)


def read_noisy(
    paths: Sequence[Path], fresh: Sequence[Path] = ()
) -> tuple[list[Episode], list[str]]:
    """Episodes of one set-up where the YAML may not say the noise, and what was done about it.

    Where none of `paths` says it, it is estimated from all of them together; where some do, the
    others take theirs. The `fresh` ones, which come last, take the same, and give none. Raises
    `EpisodeError` as `read_episode` does, and where the noise is not given and the data do not
    show it, with the motion that would.
    """
    places = [locate(Path(path)) for path in (*paths, *fresh)]
    headers = [read_header(header) for _, header in places]
    silent = [k for k, header in enumerate(headers) if header.sensor_std is None]
    if not silent:
        return [read_rows(t, h) for (t, _), h in zip(places, headers, strict=True)], []
    known = [k for k in range(len(paths)) if k not in silent]
    if known:
        std, note = headers[known[0]].sensor_std, f"sensor_std taken from {places[known[0]][1]}"
    else:
        rough = [read_rows(places[k][0], _quiet(headers[k])) for k in range(len(paths))]
        found = estimate_noise(rough)
        if found is None:
            raise EpisodeError(
                places[silent[0]][1],
                "key sensor_std is missing and no command is repeated often enough to estimate it",
                NEEDED_MOTION,
            )
        std, note = found.std, found.sentence()
    headers = [replace(h, sensor_std=h.sensor_std or std) for h in headers]
    names = ", ".join(str(places[k][1]) for k in silent)
    episodes = [read_rows(t, h) for (t, _), h in zip(places, headers, strict=True)]
    for k in () if known else silent:
        try:
            check_noise(episodes[k])
        except EpisodeError as error:
            raise EpisodeError(
                places[k][1],
                "key sensor_std is missing, and rows of one command differ by more than noise",
                "the arm creeps or lags in pauses, so record it at rest for about 10 s and give"
                " the standard deviations",
            ) from error
    return episodes, [f"{names}: {note}"]


def _quiet(header: Header) -> Header:
    """The header with noise so large that no row can be refused for it."""
    return replace(header, sensor_std=(0.05, 0.05, 0.5, 1e4, 1e4, 1e4))
