"""Doubts that an episode was accepted with: kept in its YAML, repeated by what reads it.

doubts:
- serious doubt: the recording was read otherwise than it looks, ...
- doubt: no step shows contact beyond the noise
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tpcd.errors import EpisodeError
from tpcd.quality.finding import Finding, Weight

WEIGHTS = {weight.value: weight for weight in (Weight.DOUBT, Weight.SERIOUS)}


def encode_doubts(doubts: Iterable[Finding]) -> list[dict[str, str]]:
    """The doubts as the YAML has them: weight to sentence."""
    return [{doubt.weight.value: str(doubt)} for doubt in doubts]


def parse_doubts(path: Path, content: Any) -> tuple[Finding, ...]:
    """The doubts of a YAML; plain sentences count as well. Raises `EpisodeError`."""
    if content is None:
        return ()
    entries = content if isinstance(content, list) else [content]
    found = []
    for entry in entries:
        pairs = list(entry.items()) if isinstance(entry, dict) else [(Weight.DOUBT.value, entry)]
        weight, sentence = pairs[0] if len(pairs) == 1 else (None, None)
        if weight not in WEIGHTS or not isinstance(sentence, str):
            raise EpisodeError(
                path,
                f"doubts: found {entry!r}, expected WEIGHT: SENTENCE",
                f"weights are {', '.join(WEIGHTS)}",
            )
        found.append(Finding("accepted", WEIGHTS[weight], sentence))
    return tuple(found)


def doubts_told(doubts: Iterable[Finding], path: Path | None) -> str | None:
    """One line on what an episode was accepted in spite of, the gravest first; None without."""
    order = sorted(doubts, key=lambda doubt: doubt.weight is not Weight.SERIOUS)
    if not order:
        return None
    told = "; ".join(f"{doubt.weight.value}: {doubt}" for doubt in order)
    name = "the episode" if path is None else path.name
    return f"{name} was accepted in spite of {len(order)} doubt{'s' * (len(order) > 1)}: {told}"
