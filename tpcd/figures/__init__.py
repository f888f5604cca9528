"""Pictures of beliefs and predictions: functions from arrays to a matplotlib `Figure`.

They look in from outside: nothing else in tpcd imports them. `save_figure` writes a figure
as PNG and to TensorBoard.
"""

from tpcd.figures.outline import outline_belief
from tpcd.figures.predictions import prediction
from tpcd.figures.progress import estimation_progress
from tpcd.figures.quality import calibration, central_coverage, error_bars
from tpcd.figures.scene import scene
from tpcd.figures.sinks import save_figure

__all__ = [
    "calibration",
    "central_coverage",
    "error_bars",
    "estimation_progress",
    "outline_belief",
    "prediction",
    "save_figure",
    "scene",
]
