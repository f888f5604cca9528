"""What a command is expected to teach: information gain over a belief."""

from tpcd.information.gain import (
    expected_information_gain,
    field_gain,
    pair_log_likelihood,
    reweight,
)
from tpcd.information.grid import GridSettings, grid_commands, grid_gain
from tpcd.information.outcomes import Outcomes, belief_outcomes
from tpcd.information.variance import expected_variance, present_variance

__all__ = [
    "GridSettings",
    "Outcomes",
    "belief_outcomes",
    "expected_information_gain",
    "expected_variance",
    "field_gain",
    "grid_commands",
    "grid_gain",
    "pair_log_likelihood",
    "present_variance",
    "reweight",
]
