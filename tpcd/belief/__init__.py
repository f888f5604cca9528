"""The belief over theta: likelihood, resampling, samplers, and the paper's filter."""

from tpcd.belief.belief import Belief, EstimationStep, EstimatorSettings, estimate
from tpcd.belief.cloud import SamplerSettings
from tpcd.belief.prior import ParameterPrior, make_prior
from tpcd.belief.refinement import refine

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
