"""What every particle of a belief expects a command to bring, as the sensors would tell it.

The settled pose is measured twice, directly and through the wrench w = K (x' - u), which
together are worth one reading of the pose with smaller noise. So an outcome has three
channels (x, z, phi), and its covariance holds the outline misfit, the noise of the start pose
and the noise of that reading. Of the misfit a part is a field along the outline, which the reading
teaches as it teaches theta; it is told apart from the noise.

Axes: c commands, m particles, k channels, j numbers that the field of a particle depends on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.predict import ContactPredictor
from tpcd.prediction import Prediction

LEAST_NOISE = 1e-12
"""Share of a variance that is noise at least, lest rounding make it negative."""


@dataclass(frozen=True)
class Outcomes:
    """Normal distributions of what will be read, one for each command and particle."""

    mean: Float[Tensor, "c m k"]
    factor: Float[Tensor, "c m k k"]
    """Cholesky factors of the covariances, lower triangular."""
    weights: Float[Tensor, "c m"]
    """Weights of the particles for each command, which sum to 1."""
    field: Float[Tensor, "c m k j"] | None = None
    """How the outcome answers j standard normal numbers that a particle does not know, which the
    outcome teaches; their part of the covariance is field @ field^T. None: everything that a
    particle does not know is noise."""

    @property
    def field_share(self) -> Float[Tensor, "c m k j"]:
        """The field in units in which the covariance of the outcome is 1."""
        assert self.field is not None
        return torch.linalg.solve_triangular(self.factor, self.field, upper=False)

    def after(self, first: Outcomes, command: int, outcome: Float[Tensor, " k"]) -> Outcomes:
        """The same where the outcome of a command of `first` has told of the particles' fields.

        Their numbers are standard normal again: what they are now known to be moves the means.
        """
        if self.field is None or first.field is None:
            return self
        taught = first.field_share[command]
        off = (outcome - first.mean[command])[..., None]
        known = taught.mT @ torch.linalg.solve_triangular(first.factor[command], off, upper=False)
        gram = taught.mT @ taught
        share = self.field_share
        rest = root_of_rest(share @ gram @ share.mT)
        return replace(
            self,
            mean=self.mean + (self.field @ known)[..., 0],
            factor=self.factor @ rest,
            field=self.field @ root_of_rest(gram),
        )


def root_of_rest(share: Float[Tensor, "*batch k k"]) -> Float[Tensor, "*batch k k"]:
    """Cholesky factor of what a share of the unit covariance leaves of it, in double precision."""
    one = torch.eye(share.shape[-1], dtype=share.dtype, device=share.device)
    return torch.linalg.cholesky((1.0 + LEAST_NOISE) * one - share)


def belief_outcomes(
    predictor: ContactPredictor,
    pose: Float[Tensor, " 3"],
    commands: Float[Tensor, "c 3"],
    previous: Float[Tensor, " 3"] | None,
    sensor_std: Float[Tensor, " 6"],
) -> tuple[Outcomes, Prediction]:
    """Outcomes of c commands from one measured pose [m, m, rad], and the prediction behind them.

    `previous` is the command at which the arm rests in the pose. A command that no particle
    can answer gets outcomes that do not depend on the particle, so that it teaches nothing.
    """
    start = pose.expand(len(commands), 3)
    before = None if previous is None else previous.expand(len(commands), 3)
    prediction = predictor.predict(
        start, commands, before, pose_std=sensor_std[:3], keep_field=True
    )
    reading = torch.diag(reading_variance(sensor_std, prediction.stiffness))
    covariance = prediction.component_covariance.transpose(0, 1) + reading
    mean = prediction.component_mean.transpose(0, 1)
    weights = prediction.weights.T
    none = ~prediction.answered
    if bool(none.any()):
        mean = torch.where(none[:, None, None], 0.0, mean)
        weights = torch.where(none[:, None], 1.0 / weights.shape[1], weights)
    factor = torch.linalg.cholesky(covariance)
    field = prediction.component_field
    field = None if field is None else field.transpose(0, 1)
    return Outcomes(mean, factor, weights, field), prediction


def reading_variance(
    sensor_std: Float[Tensor, " 6"], stiffness: Float[Tensor, " 3"]
) -> Float[Tensor, " 3"]:
    """Variance of the settled pose as pose and wrench together tell it [m^2, m^2, rad^2]."""
    variance = sensor_std.double() ** 2
    pose, wrench = variance[:3], variance[3:] / stiffness.double() ** 2
    total = pose + wrench
    # Two exact sensors are one exact sensor.
    return torch.where(total > 0, pose * wrench / total.clamp_min(1e-300), 0.0)
