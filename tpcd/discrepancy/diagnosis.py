"""What a diagnosis found, in plain values that can be written, compared and drawn."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from tpcd.belief.belief import Belief

Verdict = Literal[
    "nothing_missing",
    "named",
    "ambiguous",
    "formula",
    "unknown_remains",
    "not_enough_information",
]
CHANNELS = ("x", "z", "phi", "F_x", "F_z", "tau")
"""Channels of the gap in order; units m, m, rad, N, N, N·m."""
BLOCKS = "blocks held out"
"""What the gap is measured on where there are no fresh episodes."""


@dataclass(frozen=True)
class Estimate:
    """One parameter: of an effect, or an entry of theta."""

    name: str
    value: float
    """Posterior mean, in SI units."""
    sd: float
    low: float
    """90 % interval."""
    high: float
    unit: str
    shown: str = ""
    """Value and sd as text in the unit in which people read it."""


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the data ask for, with its size."""

    name: str
    parameters: tuple[Estimate, ...]
    sentence: str


@dataclass(frozen=True)
class Candidate:
    """A model that was tried in one round: the effects of the round before and one more."""

    name: str
    round: int
    """From 1; 0 for another base model."""
    gain: float
    """Log evidence minus that of the model of the round before; without a full fit what the quick
    look or the draws of that model promise."""
    by_seed: tuple[float, ...] = ()
    """Log evidence on each seed of the full fit; empty without one."""
    outcome: str = ""
    """Accepted, or why not."""


@dataclass(frozen=True)
class Alternative:
    """A model that explains the data about as well, and the motion that would decide."""

    names: tuple[str, ...]
    gain: float
    """Log evidence minus that of the model without its last effect."""
    deciding_motion: str


@dataclass(frozen=True)
class Cell:
    """One test of what a model leaves: a channel in a contact mode, against a covariate."""

    mode: str
    channel: str
    covariate: str
    score: float
    """In standard deviations of what the model itself would leave."""
    count: int
    """Transitions in the cell."""

    @property
    def words(self) -> str:
        """What is left there, in words."""
        what = {"mean": "is off on average", "size": "scatters more than its noise"}
        how = what.get(self.covariate, f"goes with the {self.covariate}")
        where = "over all rows" if self.mode == "all" else f"in contact mode '{self.mode}'"
        return f"{self.channel} {how} {where} ({self.score:+.1f} sd)"


@dataclass(frozen=True)
class Gap:
    """Root mean square errors of one-step predictions of one channel, in its SI unit."""

    channel: str
    unit: str
    contact: str
    """What the rows touch: all, free, floor, wall, or floor and wall."""
    rows: int
    """How many they are."""
    before: float
    before_low: float
    """90 % interval, as all of these: of blocks of rows drawn with replacement. NaN where there are
    too few."""
    before_high: float
    after: float
    after_low: float
    after_high: float
    noise_floor: float
    """What sensor noise alone leaves."""
    closed: float
    """Share of the excess over the noise floor that is gone; NaN without an excess."""
    closed_low: float
    """NaN also where chance may leave no excess."""
    closed_high: float


@dataclass(frozen=True)
class Limit:
    """The smallest size of an effect that these data would show, or why they show none."""

    name: str
    parameter: str
    size: float
    """Distance from the null value in SI units; infinite where no size shows."""
    shown: str
    """The value at that distance, in the unit in which people read it."""
    note: str = ""


@dataclass(frozen=True)
class Confusion:
    """Where `name` is at hand, these data could be explained by `other` as well."""

    name: str
    other: str
    likeness: float
    """Share of what the effect does to the data that the other can do too, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """All of it; `belief` is the posterior under the final model, `belief_before` that without."""

    verdict: Verdict
    sentence: str
    effects: tuple[NamedEffect, ...] = ()
    given: tuple[NamedEffect, ...] = ()
    """Effects that the model had from the start, with the sizes that these data give them."""
    alternatives: tuple[Alternative, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    log_evidence_base: float = float("nan")
    log_evidence_base_by_seed: tuple[float, ...] = ()
    """The same on each seed; seeds that missed what the best one found do not count in it."""
    log_evidence: float = float("nan")
    log_evidence_by_seed: tuple[float, ...] = ()
    gap: tuple[Gap, ...] = ()
    gap_by_contact: tuple[Gap, ...] = ()
    share_closed: float = float("nan")
    """Of the excess of all channels together, in units of the noise."""
    share_closed_low: float = float("nan")
    """90 % interval of that share."""
    share_closed_high: float = float("nan")
    share_closed_typical: float = float("nan")
    """The same where no number counts for more than in 95 % of the rows before: a row that lands in
    another contact decides nothing."""
    held_out: str = ""
    """Which data the gap was measured on."""
    cells_before: tuple[Cell, ...] = ()
    cells_after: tuple[Cell, ...] = ()
    unexplained_before: float = float("nan")
    """Share of transitions that the base model does not explain."""
    unexplained_after: float = float("nan")
    unexplained_rows: tuple[int, ...] = ()
    """Rows, counted through all episodes, that the final model does not explain."""
    theta_before: tuple[Estimate, ...] = ()
    theta_after: tuple[Estimate, ...] = ()
    shape: str = ""
    """What the data say of the outline beyond the shape prior."""
    detection_limits: tuple[Limit, ...] = ()
    confusions: tuple[Confusion, ...] = ()
    """Effects that these data could not tell apart."""
    coverage: dict[str, float] = field(default_factory=dict)
    tests: dict[str, float] = field(default_factory=dict)
    """Mean chi-square for each degree of freedom, and its probability under noise alone, of two
    tests that need no theta: `parity` of pose and wrench, and `free_space` of pose and command."""
    notes: tuple[str, ...] = ()
    seconds: float = 0.0
    belief: Belief | None = None
    belief_before: Belief | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects found."""
        return tuple(effect.name for effect in self.effects)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for `verdict.json`, without the beliefs."""
        parts = {k: v for k, v in vars(self).items() if not k.startswith("belief")}
        names = {
            "before": "log_evidence_base",
            "before_by_seed": "log_evidence_base_by_seed",
            "after": "log_evidence",
            "after_by_seed": "log_evidence_by_seed",
            "candidates": "candidates",
        }
        evidence = {key: parts.pop(name) for key, name in names.items()}

        def plain(value: Any) -> Any:
            if isinstance(value, (tuple, list)):
                return [plain(one) for one in value]
            if hasattr(value, "__dataclass_fields__"):
                return asdict(value)
            return value

        found = {k: plain(v) for k, v in parts.items()}
        return found | {"evidence": {k: plain(v) for k, v in evidence.items()}}
