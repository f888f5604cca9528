"""The belief over theta: likelihood, resampling, samplers, and the paper's filter."""

from tpcd.belief.belief import Belief, EstimationStep, estimate
from tpcd.belief.prior import ParameterPrior, make_prior
from tpcd.belief.refinement import refine
from tpcd.belief.settings import EstimatorSettings, SamplerSettings

__all__ = [
    "Belief",
    "EstimationStep",
    "EstimatorSettings",
    "ParameterPrior",
    "SamplerSettings",
    "estimate",
    "make_prior",
    "refine",
]
