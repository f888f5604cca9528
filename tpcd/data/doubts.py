"""Doubts that an episode was accepted with: kept in its YAML, repeated by what reads it.

doubts:
- serious doubt: the recording was read otherwise than it looks, ...
- doubt: no step shows contact beyond the noise
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tpcd.errors import EpisodeError
from tpcd.quality.finding import Finding, Weight

WEIGHTS = {weight.value: weight for weight in (Weight.DOUBT, Weight.SERIOUS)}

WEIGHED = re.compile(r"([\w\s]*doubt)\s*:(.*)", re.IGNORECASE | re.DOTALL)
"""A doubt as one text: what YAML makes of it in quotes."""


def encode_doubts(doubts: Iterable[Finding]) -> list[dict[str, str]]:
    """The doubts as the YAML has them: weight to sentence."""
    return [{doubt.weight.value: str(doubt)} for doubt in doubts]


def parse_doubts(path: Path, content: Any) -> tuple[Finding, ...]:
    """The doubts of a YAML, in quotes or not; plain sentences count as well. Raises
    `EpisodeError`."""
    if content is None:
        return ()
    found = []
    for entry in content if isinstance(content, list) else [content]:
        weight, sentence = Weight.DOUBT.value, entry
        if isinstance(entry, dict) and len(entry) == 1:
            ((weight, sentence),) = entry.items()
        elif isinstance(entry, str) and (quoted := WEIGHED.match(entry)):
            weight, sentence = quoted.groups()
        weight = " ".join(str(weight).lower().split())
        if weight not in WEIGHTS or not isinstance(sentence, str) or not sentence.strip():
            raise EpisodeError(
                path,
                f"doubts: found {entry!r}, expected WEIGHT: SENTENCE",
                f"weights are {', '.join(WEIGHTS)}",
            )
        found.append(Finding("accepted", WEIGHTS[weight], " ".join(sentence.split())))
    return tuple(found)


def doubts_told(doubts: Iterable[Finding], path: Path | None) -> str | None:
    """One line on what an episode was accepted in spite of, the gravest first; None without."""
    order = sorted(doubts, key=lambda doubt: doubt.weight is not Weight.SERIOUS)
    if not order:
        return None
    told = "; ".join(f"{doubt.weight.value}: {doubt}" for doubt in order)
    name = "the episode" if path is None else path.name
    return f"{name} was accepted in spite of {len(order)} doubt{'s' * (len(order) > 1)}: {told}"
