"""Where figures go: PNG files in a result folder, images in a TensorBoard run."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tpcd.files import staged


@runtime_checkable
class ImageWriter(Protocol):
    """The part of TensorBoard's `SummaryWriter` that figures need."""

    def add_image(
        self, tag: str, img_tensor: Any, global_step: Any = None, *, dataformats: str = "CHW"
    ) -> Any:
        """Store one image under a tag."""
        ...


def save_figure(
    figure: Figure,
    folder: str | Path,
    name: str,
    writer: ImageWriter | None = None,
    step: int = 0,
    heading: str = "figures",
) -> Path:
    """Write `folder/name.png`, and the same image to TensorBoard where a writer is given.

    `name` is a file name without its ending; the tag `heading/name` puts the figures of a run, or
    of one object of it, under one heading. The file appears complete or not at all.
    """
    if not name or Path(name).name != name:
        raise ValueError(f"name of a figure is {name!r}, expected a file name without a folder")
    path = Path(folder) / f"{name}.png"
    with staged(path) as temporary:
        figure.savefig(temporary, format="png", dpi="figure", facecolor="white")
    if writer is not None:
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        image = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        writer.add_image(f"{heading}/{name}", image, step, dataformats="HWC")
    return path
