"""Choices and thresholds of the gap workflow."""

from __future__ import annotations

from dataclasses import dataclass, field

from tpcd.belief.settings import SamplerSettings
from tpcd.discrepancy.fit import FIT_SAMPLER
from tpcd.effects import CATALOGUE
from tpcd.effects.protocol import Effect
from tpcd.effects.shape_change import UNCHANGED, ShapeChange
from tpcd.simulator import StepSettings

FEWEST_ROWS = 10
"""Transitions below which nothing is named."""
FRESH = {True: 8, False: 40}
"""Points of a quick look that set out from all over the prior, where the model explains the data
and where it does not."""
WEIGHED = 6
"""Candidates whose gain is weighed on draws of the model without them."""
TOLD = 0.5
"""Standard error of that gain below which it stands for what the quick look finds,"""
ELSEWHERE = 4.0
"""if that is not so much more: looks at effects that are not there were off by 2.2 at most."""
PROMISING = {True: 1.0, False: 0.0}
"""Gain that a candidate has to promise for a full fit: where the model explains the data as it is,
and where it does not."""
QUICK = {"draws": 300, "flat_draws": 200, "flat_rounds": 2}
"""Budget of the quick fits, in one pass, where something is left and nothing promises a gain,"""
QUICK_SEED = 50
"""and their seed."""
BEATEN = 25.0
"""A candidate that promises so much less than the best full fit gets none."""
WITHIN = 5.0
"""Candidates whose gain is so close to the best get a second seed: what comes within `AMBIGUOUS` is
told, and seeds differ by a nat or two."""
FEW_DRAWS = 10
"""Effective number of draws of a model below which, where it leaves something, what promises any
gain beside it is fitted: its search has gone astray, and so have looks from where it arrived,"""
ASTRAY = 25.0
"""and candidates so close to the best get a second seed: the first may have missed as much."""
IMPROVED = 2.0
"""Gain of the base model fitted again from which the best candidates are fitted again too."""
CLOSER = 3
"""Times the places from which points climb where a candidate that neither wins nor loses clearly is
fitted again, unless draws agree with the fits."""
CLOSER_SEEDS = (30, 31, 32)
"""Seeds of that, of which further ones are used while the search still climbs."""
CLIMBING = 2.0
"""Gain of log evidence with which a search that is made again still climbs."""
AGREED = 2.0
"""A second seed may miss the gain that is asked for by so much, and the gain by draws may differ
by so much from that of the fits where neither has missed anything."""
UNDECIDED = {True: 2.0, False: -10.0}
"""Gain from which it does not lose clearly: where the model explains the data, and where not."""
AMBIGUOUS = 3.0
CLEAR = 25.0
"""Gain from which a candidate wins clearly, and is not looked at more closely."""
SURE = 10.0
"""Gain from which blocks held out have no veto. Where an effect shows in one stretch of the data
alone, the model fitted without that stretch does not know it, and the veto is blind: of judged
candidates that gained 10 to 25, it had stopped one false name and four true ones. Clean data
never gained more than 8.9 in 424 diagnoses."""
VETO_LEVEL = 0.2
"""Of the bound of the held-out gain. What shows in one stretch of the data alone, such as a push
that static friction holds, is missed by the bootstrap in a third of its draws, so that a bound
at 5 % would never let it pass."""
RIVAL_SEEDS = (33, 34, 35)
"""Seeds of that for a formula in place of effects."""
RIVAL_WITHIN = 15.0
"""A formula is fitted in full where the quick look misses what it has to gain by no more,"""
NEARLY_OUTDONE = 5.0
"""and looked at more closely where the fit does."""
FORMULA_COUNTS = 2
"""Effects that a formula counts for: it is as much less likely beforehand."""
REPORTED_SEEDS = (40, 41, 42, 43)
"""Seeds of the fits whose posterior is reported: two, and on while few draws count."""
ENOUGH_DRAWS = 50
"""Effective number of draws with which no further seed is used."""
FEWEST_DRAWS = 5
"""Effective number of draws below which intervals are said to be unsure, and draws tell no gain."""


@dataclass(frozen=True)
class DiagnosisSettings:
    """Choices of the workflow."""

    seed: int = 0
    base_refit: bool = True
    """Fit the base model again from where the alternatives arrived."""
    from_prior: bool = True
    """Search for modes from all over the prior; else only from where the base model arrived."""
    adequacy: bool = True
    """Test whether the final model explains the data."""
    parity: bool = True
    """Let what pose and wrench say about each other count."""
    most_effects: int = 3
    full_fits: int = 4
    """Candidates of a round that are fitted in full."""
    least_gain: float = 6.0
    """Gain of log evidence at which an effect is accepted: 3 and the logarithm of the number of
    candidates, each of which has a share of the prior odds."""
    level: float = 0.001
    """Level of the test that says whether something is left."""
    step: StepSettings = field(default_factory=StepSettings)
    shape: ShapeChange = UNCHANGED
    """What is expected of the object besides what the shape model says."""
    sampler: SamplerSettings = FIT_SAMPLER
    catalogue: tuple[Effect, ...] = CATALOGUE
