"""Figures: labelled with units, showing the data they were given, written whole."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.path import Path as Outline
from matplotlib.quiver import Quiver

from tpcd import figures
from tpcd.figures.outline import inside_probability
from tpcd.figures.style import display_unit

NAMES = ("scale", "mount_x", "mount_z", "mount_phi", "friction", "floor_height", "wall_position")
UNITS = ("1", "m", "m", "rad", "1", "m", "m")


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(7)


def star(angle: float = 0.0, size: float = 0.04, p: int = 48) -> np.ndarray:
    """A made-up outline that is not convex, counter-clockwise [m]."""
    turn = np.linspace(0, 2 * np.pi, p, endpoint=False)
    radius = size * (1 + 0.35 * np.cos(3 * turn))
    return np.stack((radius * np.cos(turn + angle), radius * np.sin(turn + angle)), axis=-1)


def progress(generator: np.random.Generator, **changes) -> Figure:
    steps = np.arange(16)
    width = 0.02 * np.exp(-steps / 4)[:, None] * np.ones(7)
    mean = 0.1 + np.cumsum(0.1 * width * generator.standard_normal((16, 7)), axis=0)
    given = {
        "steps": steps,
        "mean": mean,
        "low": mean - width,
        "high": mean + width,
        "names": NAMES,
        "units": UNITS,
        "truth": mean[-1] + 0.001,
    }
    return figures.estimation_progress(**(given | changes))


def predicted(generator: np.random.Generator) -> Figure:
    scale = np.array([1e-3, 1e-3, 1e-2, 0.5, 0.5, 0.05])
    mean = np.cumsum(scale * generator.standard_normal((30, 6)), axis=0)
    rows = mean + 0.6 * scale * generator.standard_normal((30, 6))
    return figures.prediction(rows, mean, mean - scale, mean + scale, "mug, rollout 1")


def moved(**changes) -> Figure:
    n = np.linspace(0, 1, 20)
    poses = np.stack((0.12 * n, 0.06 - 0.02 * n, 0.6 * n), axis=-1)
    given = {
        "poses": poses,
        "points_ee": star(),
        "floor": (-0.004, -0.007, -0.001),
        "wall": (0.165, 0.155, 0.176),
        "true_floor": -0.005,
        "true_wall": 0.162,
        "commands": poses + np.array([0.01, -0.012, 0.0]),
    }
    return figures.scene(**(given | changes))


def table() -> list[dict]:
    return [
        {"object": name, "prior": prior, "x_mm": value + shift, "F_x": 0.1 * value}
        for shift, prior in enumerate(("ycb21-z2", "rich"))
        for name, value in (("mug", 0.4), ("bleach cleanser", 1.9), ("power drill", 0.8))
    ]


def errors() -> Figure:
    return figures.error_bars(
        table(),
        {"x_mm": "mean error of x [mm]", "F_x": "mean error of F_x [N]"},
        group="prior",
        targets={"x_mm": 0.8},
    )


def believed(generator: np.random.Generator, **changes) -> Figure:
    spread = generator.normal(0, [0.3, 0.002], (200, 2))
    points = np.stack([star(angle, 0.04 + size) for angle, size in spread])
    given = {"points_ee": points, "weights": np.ones(200), "truth_points": star(0.1)}
    return figures.outline_belief(**(given | changes))


def calibrated(generator: np.random.Generator) -> Figure:
    return figures.calibration(generator.beta(0.8, 0.8, (90, 6)), ["x", "z", "φ", "Fx", "Fz", "τ"])


def all_figures(generator: np.random.Generator) -> dict[str, Figure]:
    return {
        "progress": progress(generator),
        "outline": believed(generator),
        "scene": moved(),
        "prediction": predicted(generator),
        "calibration": calibrated(generator),
        "errors": errors(),
    }


def test_every_axis_says_its_quantity_and_unit(generator: np.random.Generator) -> None:
    for name, figure in all_figures(generator).items():
        for panel in figure.axes:
            if panel.get_label() == "<colorbar>":
                continue
            assert "[" in panel.get_xlabel() or panel.get_xlabel() in ("step", ""), name
            assert "[" in panel.get_ylabel() or name == "errors", name


def test_every_figure_is_written_as_an_image_with_content(
    generator: np.random.Generator, tmp_path: Path
) -> None:
    for name, figure in all_figures(generator).items():
        path = figures.save_figure(figure, tmp_path / "figures", name)
        image = imread(path)
        assert min(image.shape[:2]) > 300
        assert image[..., :3].std() > 0.02, name
    assert len(list((tmp_path / "figures").iterdir())) == 6


def test_nothing_of_a_figure_is_cut_off(generator: np.random.Generator) -> None:
    """Regression: the legend of a scene without known truth was wider than the figure."""
    drawn = all_figures(generator)
    drawn["unknown"] = moved(true_floor=None, true_wall=None)
    far = np.stack((np.linspace(0, 0.6, 8), np.full(8, 0.05), np.zeros(8)), axis=1)
    drawn["long"] = moved(poses=far, commands=far)
    for name, figure in drawn.items():
        FigureCanvasAgg(figure).draw()
        extent = figure.get_tightbbox().padded(-0.01)
        width, height = figure.get_size_inches()
        assert extent.x0 >= 0 and extent.y0 >= 0, name
        assert extent.x1 <= width and extent.y1 <= height, name


def test_lengths_are_drawn_in_millimetres_and_angles_in_degrees(
    generator: np.random.Generator,
) -> None:
    assert display_unit("m") == (1e3, "mm")
    panels = {panel.get_ylabel(): panel for panel in progress(generator).axes}
    assert set(panels) >= {"floor height [mm]", "mount phi [°]", "friction [–]"}
    drawn = panels["floor height [mm]"].lines[0].get_ydata()
    assert 50 < np.mean(drawn) < 150


def test_progress_shows_the_means_and_the_truth(generator: np.random.Generator) -> None:
    mean = np.tile(np.linspace(0.2, 0.4, 5)[:, None], (1, 1))
    figure = progress(
        generator,
        steps=np.arange(5),
        mean=mean,
        low=mean - 0.1,
        high=mean + 0.1,
        names=("friction",),
        units=("1",),
        truth=np.array([0.35]),
    )
    (panel,) = figure.axes
    line, truth = panel.lines
    np.testing.assert_allclose(line.get_ydata(), mean[:, 0])
    np.testing.assert_allclose(truth.get_ydata(), 0.35)


def test_progress_refuses_names_that_do_not_match(generator: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="6 names"):
        progress(generator, names=NAMES[:6])


def test_tensors_are_drawn_like_arrays(generator: np.random.Generator) -> None:
    arrays = believed(generator, weights=np.ones(200)).axes[0].images[0].get_array()
    same = np.random.default_rng(7)
    points = torch.from_numpy(
        np.stack([star(a, 0.04 + s) for a, s in same.normal(0, [0.3, 0.002], (200, 2))])
    )
    tensors = believed(same, points_ee=points, weights=torch.ones(200)).axes[0].images[0]
    np.testing.assert_allclose(tensors.get_array(), arrays, atol=1e-6)


@pytest.mark.parametrize("orientation", [1, -1])
def test_the_image_of_one_outline_is_its_inside(orientation: int) -> None:
    outline = star(0.3)[::orientation]
    low, high, pixel = np.array([-0.06, -0.07]), np.array([0.06, 0.05]), 0.0011
    image = inside_probability(outline[None], np.ones(1), low, high, pixel)
    rows, columns = image.shape
    x = low[0] + (np.arange(columns) + 0.5) * pixel
    z = low[1] + (np.arange(rows) + 0.5) * pixel
    centres = np.stack(np.meshgrid(x, z), axis=-1).reshape(-1, 2)
    inside = Outline(np.concatenate((outline, outline[:1]))).contains_points(centres)
    assert (image.ravel().round(9) != inside).mean() == 0
    assert 0 < inside.sum() < inside.size


def test_the_image_of_many_outlines_is_the_weighted_mean_of_their_images(
    generator: np.random.Generator,
) -> None:
    outlines = np.stack([star(angle)[:: (-1) ** k] for k, angle in enumerate((0.0, 0.5, 1.3))])
    weights = np.array([0.5, 0.2, 0.3])
    low, high = np.array([-0.05, -0.05]), np.array([0.06, 0.06])
    single = [inside_probability(o[None], np.ones(1), low, high, 0.002) for o in outlines]
    image = inside_probability(outlines, 10 * weights, low, high, 0.002)
    np.testing.assert_allclose(image, np.tensordot(weights, single, 1), atol=1e-12)


def test_the_scene_shows_every_position_and_both_surfaces() -> None:
    (panel,) = moved().axes
    path = next(line for line in panel.lines if len(line.get_xdata()) == 20)
    np.testing.assert_allclose(path.get_xdata(), 120 * np.linspace(0, 1, 20), atol=1e-9)
    (left, right), (bottom, top) = panel.get_xlim(), panel.get_ylim()
    assert left < 0 and right > 176 and bottom < -7 and top > 60


def test_forces_enter_the_outline_where_it_is_touched() -> None:
    """A square beside the end effector, pushed from below and from the right, and hardly at all."""
    square = np.array([[0.02, -0.02], [0.06, -0.02], [0.06, 0.02], [0.02, 0.02]])
    poses = np.array([[0.0, 0.05, 0.0], [0.01, 0.05, 0.0], [0.02, 0.05, 0.0]])
    up, left, small = (0.0, 10.0, 10.0 * 0.03), (-5.0, 0.0, 5.0 * 0.01), (0.5, 0.0, 0.0)
    figure = moved(
        poses=poses, points_ee=square, commands=None, wrenches=np.array([up, left, small])
    )
    (panel,) = figure.axes
    (arrows,) = (one for one in panel.collections if isinstance(one, Quiver))
    tips = arrows.XY + np.stack((arrows.U, arrows.V), axis=-1)
    np.testing.assert_allclose(tips, [[30.0, 30.0], [70.0, 60.0]], atol=1e-9)
    lengths = np.hypot(arrows.U, arrows.V)
    assert lengths[1] == pytest.approx(0.5 * lengths[0])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "contact force, at most 10.0 N" in labels


def test_a_scene_without_any_force_has_no_arrows() -> None:
    (panel,) = moved(wrenches=np.zeros((20, 3))).axes
    assert not any(isinstance(one, Quiver) for one in panel.collections)


def test_a_surface_at_zero_is_a_truth_too() -> None:
    (panel,) = moved(true_floor=0.0).axes
    assert any(np.allclose(line.get_ydata(), 0.0) for line in panel.lines)


def test_prediction_panels_count_what_lies_inside() -> None:
    mean = np.zeros((10, 6))
    rows = mean.copy()
    rows[:3, 3] = 2.0
    figure = figures.prediction(rows, mean, mean - 1, mean + 1)
    titles = [panel.get_title(loc="left") for panel in figure.axes]
    assert titles[3] == "mean error 0.6 N, 7 of 10 inside"
    assert all("10 of 10 inside" in text for i, text in enumerate(titles) if i != 3)


def test_coverage_of_a_uniform_transform_is_the_level() -> None:
    transform = (np.arange(1000)[:, None] + 0.5) / 1000
    levels = np.array([0.1, 0.5, 0.9])
    np.testing.assert_allclose(
        figures.central_coverage(transform, levels)[:, 0], levels, atol=0.002
    )


def test_bars_are_ordered_and_as_long_as_the_errors() -> None:
    panel, other = errors().axes
    lengths = [patch.get_width() for patch in panel.patches]
    np.testing.assert_allclose(lengths, [0.4, 0.8, 1.9, 1.4, 1.8, 2.9])
    assert [text.get_text() for text in panel.get_yticklabels()] == [
        "mug",
        "power drill",
        "bleach cleanser",
    ]
    assert len(other.patches) == 6


class Recorder:
    """Stands for TensorBoard's writer."""

    def __init__(self) -> None:
        self.images: list = []

    def add_image(self, tag, img_tensor, global_step=None, *, dataformats="CHW"):
        self.images.append((tag, img_tensor.shape, img_tensor.dtype, global_step, dataformats))


def test_a_writer_gets_the_same_image_with_its_step(tmp_path: Path) -> None:
    recorder = Recorder()
    path = figures.save_figure(moved(), tmp_path, "scene", recorder, step=4)
    ((tag, shape, dtype, step, layout),) = recorder.images
    assert (tag, step, layout, dtype) == ("figures/scene", 4, "HWC", np.uint8)
    assert shape == (*imread(path).shape[:2], 3)


def test_a_figure_name_with_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="without a folder"):
        figures.save_figure(moved(), tmp_path, "../scene")


def test_drawing_does_not_touch_the_global_state_of_pyplot() -> None:
    code = "import sys, tpcd.figures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1]).returncode == 0
    )


def test_a_missing_error_leaves_a_gap() -> None:
    rows = [{"object": "mug", "x_mm": 1.0}, {"object": "bowl", "x_mm": None}]
    (panel,) = figures.error_bars(rows, {"x_mm": "error of x [mm]"}).axes
    lengths = [patch.get_width() for patch in panel.patches]
    assert np.isnan(lengths[0]) and lengths[1] == 1.0


def test_labels_name_the_unit_shown_and_keep_subscripts() -> None:
    from tpcd.figures.style import axis_label

    assert axis_label("floor_height", "m") == "floor height [mm]"
    assert axis_label("mount_phi", "rad") == "mount phi [°]"
    assert axis_label("$F_x$", "N") == "$F_x$ [N]"
    assert axis_label("scale", "1") == "scale [–]"


def test_channels_of_one_curve_share_a_line_and_its_name() -> None:
    transform = np.random.default_rng(0).uniform(size=(50, 2))
    figure = figures.calibration(transform[:, [0, 1, 0]], ["x", "z", "F_x"])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [label.split(" (")[0] for label in labels[:2]] == ["x, F_x", "z"]
    # Two curves and the diagonal.
    assert len(figure.axes[0].lines) == 3
