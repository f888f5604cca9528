"""What the page of a diagnosis shows besides the gap, as text for people."""

from __future__ import annotations

from collections.abc import Sequence


def shown_evidence(log_evidence: float, by_seed: Sequence[float]) -> str:
    """Log evidence, and what each seed gave, as text: `12.1 (seeds: 12.3, 11.9)`."""
    seeds = ", ".join(f"{value:.1f}" for value in by_seed)
    return f"{log_evidence:.1f}" + (f" (seeds: {seeds})" if seeds else "")
