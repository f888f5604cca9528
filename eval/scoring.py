"""Predictions of test recordings against the noise-free truth, one step ahead."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.commands.prediction import in_contact, measured_rows, one_step, prediction_error
from tpcd.predict import ContactPredictor
from tpcd.truth.recording import Recording


def score_tests(
    predictor: ContactPredictor, tests: Sequence[Recording]
) -> tuple[Float[Tensor, "n 6"], Float[Tensor, "n 6"], Bool[Tensor, " n"]]:
    """Absolute errors of the mean [m, m, rad, N, N, N·m], the predicted distribution functions at
    the truth, and which rows touch, for all rows of the recordings, from noisy measured poses.
    """
    errors, transforms = [], []
    for test in tests:
        predicted, rows = one_step(predictor, test.measured, "true"), measured_rows(test.true)[1:]
        errors.append(prediction_error(rows, predicted.mean))
        transforms.append(predicted.probability_below(rows))
    touching = [in_contact(test.true) for test in tests]
    return torch.cat(errors).abs(), torch.cat(transforms), torch.cat(touching)
