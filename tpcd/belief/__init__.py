"""The belief over theta: likelihood, resampling, samplers, and the paper's filter."""

from tpcd.belief.belief import Belief, EstimationStep, EstimatorSettings, estimate, refine
from tpcd.belief.cloud import SamplerSettings
from tpcd.belief.prior import ParameterPrior, make_prior

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
