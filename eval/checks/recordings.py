"""Mistaken conventions, faults of channels, and clocks apart, in recordings that are else right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from tests.made_dynamics import an_arm, parts_of
from tests.made_logs import an_episode, choices_of, log_of, sampled
from tests.made_mistakes import ALONG, DOWN, MISTAKES, PAIRS, TURNED, convention_doubts
from tests.made_streams import STEPS, alarms, changed, frozen, made_stream
from tpcd.quality.channels import check_channels
from tpcd.quality.delay import estimate_delays
from tpcd.quality.finding import Finding
from tpcd.quality.stream import Stream

SENSORS = ((1.0, 0.0), (1.0, 0.3), (1.0, 1.0))
"""Noise of a channel and its steps, in usual standard deviations."""
FROZEN, CLIPPED, SPIKES = (5, 10, 20, 40, 80, 160), (0.02, 0.1), (10, 20, 40)
"""Samples; part of them beyond the range; size in standard deviations."""
DELAYS = (0.05, 0.2, -0.3)
"""[s]"""


def convention_runs(seed: int) -> list[dict[str, Any]]:
    """One episode read rightly in three settings, and with each mistake and pair of mistakes; the
    sensor has a gain of 5 %, is turned by 3 degrees and errs by 0.3 N from step to step."""
    made, random = an_episode(14, seed), np.random.default_rng(seed)
    wrenches = made.wrenches.clone()
    turn = Rotation.from_euler("z", 3, degrees=True).as_matrix()[:2, :2]
    wrenches[:, :2] = 1.05 * wrenches[:, :2] @ torch.from_numpy(turn.T)
    wrenches[1:] += torch.from_numpy(random.normal(0, (0.3, 0.3, 0.02), (len(made) - 1, 3)))
    samples, rows = sampled(replace(made, wrenches=wrenches), seed), []
    for setting in (ALONG, DOWN, TURNED):
        doubts = convention_doubts(log_of(setting, samples), choices_of(setting))
        rows.append({"of": ["read rightly"], "told": bool(doubts), "others": 0})
    for mistaken in (*((name,) for name in MISTAKES), *PAIRS):
        log, choices = log_of(TURNED, samples), choices_of(TURNED)
        # Numbers are put in another order last, so that is undone first.
        for name in reversed(mistaken):
            log, choices = MISTAKES[name][0](log, choices)
        doubts = convention_doubts(log, choices)
        told = str(doubts[0]).split(", or with")[0] if doubts else ""
        said = {name for name, (_, remedy) in MISTAKES.items() if remedy in told}
        case = "one mistake" if len(mistaken) == 1 else "two mistakes"
        others = bool(said - set(mistaken))
        rows.append({"of": [case], "told": set(mistaken) <= said, "others": others})
    return rows


def channel_runs(seed: int) -> list[dict[str, Any]]:
    """Clean channels, frozen and clipped stretches of several lengths, and spikes."""
    random, rows = np.random.default_rng(seed), []
    for noise, steps in SENSORS:
        stream = made_stream(noise, steps, seed)
        case = f"steps of {steps:g} sd"
        count = len(alarms(check_channels([stream])))
        rows.append({"of": [case, "clean"], "told": count > 0, "others": count})
        for length in FROZEN:
            name = str(random.choice(["F_x", "F_z", "T_y", "x", "z"]))
            first = int(random.integers(50, len(stream.times) - length - 50))
            faulty = frozen(stream, (name,), first, first + length)
            what = f"frozen for {length} samples"
            rows.append(_told(case, what, faulty, "frozen", name, [(first, first + length)]))
        for part in CLIPPED:
            column = stream.values[:, stream.channels.index("F_x")]
            limit = float(np.quantile(column, 1 - part))
            values = stream.values.copy()
            values[:, stream.channels.index("F_x")] = np.minimum(column, limit)
            cut = np.flatnonzero(np.diff(np.pad(column >= limit, 1).astype(int))).reshape(-1, 2)
            longest = cut[np.argmax(cut[:, 1] - cut[:, 0])]
            clipped, what = replace(stream, values=values), f"{part:.0%} clipped, longest stretch"
            rows.append(_told(case, what, clipped, "clipped", "F_x", [longest, *cut]))
        for size in SPIKES:
            name = str(random.choice(["F_x", "F_z", "T_y", "x", "z"]))
            at, column = int(random.integers(50, len(stream.times) - 50)), stream.channels.index
            value = stream.values[at, column(name)] + size * STEPS[column(name)]
            faulty = changed(stream, name, at, at + 1, value)
            rows.append(_told(case, f"spike of {size} sd", faulty, "spike", name, [(at, at + 1)]))
    return rows


def _told(
    case: str, what: str, stream: Stream, kind: str, name: str, places: Sequence[Any]
) -> dict[str, Any]:
    """Whether the first place is told, and how many alarms are at none of them."""

    def at(each: Finding, place: Any) -> bool:
        first, end = each.rows or (0, 0)
        return each.channels == (name,) and first < place[1] and place[0] < end

    told = alarms(check_channels([stream]))
    found = any(each.kind == kind and at(each, places[0]) for each in told)
    others = sum(not any(at(each, place) for place in places) for each in told)
    return {"of": [case, what], "told": found, "others": others}


def delay_runs(seed: int) -> list[dict[str, Any]]:
    """An arm of some stiffness and mass, whose wrench or set point has a clock of its own."""
    random = np.random.default_rng(seed)
    arm = an_arm(30.0 * 33.0 ** random.uniform(), random.uniform(3.0, 6.0), seed, 20)
    rows = []
    for late, delay in ((None, 0.0), *((of, d) for of in ("wrench", "command") for d in DELAYS)):
        parts = parts_of(arm, **({late: delay} if late else {}))
        for each in estimate_delays(parts):
            true = delay if each.of == late else 0.0
            name = {"wrench": "wrench", "command": "set point"}[each.of]
            held = each.low <= true <= each.high if each.known else None
            error = abs(each.value - true) if each.known else None
            row = {"of": [name, f"{true:g} s"], "told": each.known, "held": held, "size": error}
            rows += [row, {"table": "doubts", "of": row["of"], "told": each.doubtful}]
    return rows
