"""Plots of a calibration: residual fields, errors per view, uncertainty over the image, the rig in space.

They take arrays and draw; what the numbers mean is said by `calibration_report.py`. Pixels are COLMAP's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from preface.geometry.cameras import Camera
from preface.geometry.transforms import Rigid
from preface.reports import finite_range, new_figure

PAGE_WIDTH = 12.6  # inches
PANELS_PER_ROW = 5
LARGEST_PANEL = 3.6  # inches wide
CELLS = 14  # of a residual field along the image's longer side
MIN_IN_CELL = 3  # sightings; the mean of fewer is noise
MAX_FRAME_TICKS = 50
MAX_POINTS = 4000  # of a cloud; more make a page heavy and show nothing new
NAME_DISTANCE = 0.05  # of the plot's height, between names that stay legible
INK, SOFT, ACCENT, EMPTY = "#1c1e21", "#8a9199", "#0b62c4", "#e4e7ea"


@dataclass(frozen=True)
class CameraResiduals:
    """The sightings of one camera that the solver used.

    Attributes:
        name: of the camera.
        size: (width, height) of its images.
        pixels: [N, 2] where points were measured.
        residuals: [N, 2] projected minus measured, pixels.
    """

    name: str
    size: tuple[int, int]
    pixels: np.ndarray = field(repr=False)
    residuals: np.ndarray = field(repr=False)


def residual_fields(cameras: Sequence[CameraResiduals]) -> tuple[Figure, float]:
    """Errors over each camera's image: colour is their root mean square, arrows are their mean, per cell.

    Returns:
        the figure, and how many pixels of error an arrow as long as a cell stands for.
    """
    cells = [_Cells.of(camera) for camera in cameras]
    lengths = np.concatenate([np.linalg.norm(c.mean, axis=-1)[c.enough] for c in cells])
    unit = _round_up(float(np.percentile(lengths, 95))) if lengths.size else 1.0
    spread = np.concatenate([c.rms[c.enough] for c in cells])
    figure, axes = _panels([camera.size for camera in cameras])
    scale = Normalize(0, _twice_the_usual(spread))
    for axis, camera, cell in zip(axes, cameras, cells, strict=False):
        width, height = camera.size
        rows, columns = cell.count.shape
        extent = (0, columns * cell.side, rows * cell.side, 0)
        shown = np.where(cell.enough, cell.rms, np.nan)
        picture = axis.imshow(shown, extent=extent, cmap="YlOrRd", norm=scale, alpha=0.75)
        x, y = np.meshgrid((np.arange(columns) + 0.5) * cell.side, (np.arange(rows) + 0.5) * cell.side)
        arrows = cell.mean[cell.enough] * (cell.side / unit)
        axis.quiver(
            x[cell.enough],
            y[cell.enough],
            arrows[:, 0],
            arrows[:, 1],
            angles="xy",
            scale_units="xy",
            scale=1,
            color=INK,
            width=0.006,
        )
        _image_axes(axis, camera.name, width, height)
    figure.colorbar(picture, ax=axes, label="RMS error (px)", shrink=0.7, pad=0.01)
    return figure, unit


def coverage_maps(cameras: Sequence[CameraResiduals]) -> Figure:
    """Every point that the solver used, where the camera saw it."""
    figure, axes = _panels([camera.size for camera in cameras])
    for axis, camera in zip(axes, cameras, strict=False):
        axis.plot(*camera.pixels.T, ".", color=ACCENT, markersize=1.2, alpha=0.4)
        _image_axes(axis, camera.name, *camera.size)
    return figure


def uncertainty_maps(
    names: Sequence[str], sizes: Sequence[tuple[int, int]], maps: Sequence[np.ndarray]
) -> Figure:
    """Standard deviations [h, w] over each camera's image, one scale for all; NaN stays white.

    Args:
        names, sizes: of the cameras; sizes are (width, height).
        maps: pixels, sampled evenly over the image.
    """
    _, top = finite_range(np.concatenate([m.ravel() for m in maps]), 0, 98)
    figure, axes = _panels(sizes)
    for axis, name, (width, height), values in zip(axes, names, sizes, maps, strict=False):
        extent = (0, width, height, 0)
        picture = axis.imshow(values, extent=extent, cmap="magma_r", norm=Normalize(0, top))
        _image_axes(axis, name, width, height)
    figure.colorbar(picture, ax=axes, label="standard deviation (px)", shrink=0.7, pad=0.01)
    return figure


def error_matrix(errors: np.ndarray, camera_ids: Sequence[str], frame_ids: Sequence[str]) -> Figure:
    """RMS error [C, F] of every view in pixels; NaN, where a camera did not see the board, is grey."""
    cameras, frames = errors.shape
    figure = new_figure(PAGE_WIDTH, max(1.8, 0.24 * cameras + 1.3))
    axis = figure.axes[0]
    scale = Normalize(0, _twice_the_usual(errors))
    picture = axis.imshow(errors, aspect="auto", cmap="YlOrRd", norm=scale, interpolation="none")
    axis.set_facecolor(EMPTY)
    axis.grid(visible=False)
    step = -(-frames // MAX_FRAME_TICKS)
    axis.set_xticks(
        range(0, frames, step), [str(name) for name in frame_ids[::step]], rotation=90, fontsize=7
    )
    axis.set_yticks(range(cameras), [str(name) for name in camera_ids])
    axis.set_xlabel("frame")
    figure.colorbar(picture, ax=axis, label="RMS error (px)", pad=0.01)
    return figure


def rig_view(
    names: Sequence[str], cameras: Sequence[Camera], camera_from_rig: Rigid, boards: np.ndarray
) -> Figure:
    """The rig in space, from above and from the side: cameras with their fields of view, boards, and lengths.

    Args:
        names, cameras: C of them.
        camera_from_rig: C poses.
        boards: [F, 4, 3] corners of the board in each frame, rig frame, metres.
    """
    middle = np.median(boards.mean(axis=1), axis=0)
    upright = _upright(camera_from_rig, middle)
    centers = (camera_from_rig.inverse.translation - middle) @ upright.T
    outlines = (boards - middle) @ upright.T
    reach = 0.25 * float(np.median(np.linalg.norm(centers, axis=1)))
    frusta = []
    for index, camera in enumerate(cameras):
        rays = _corner_rays(camera)
        corners = (rays * reach - camera_from_rig.translation[index]) @ camera_from_rig.rotation[index]
        frusta.append((corners - middle) @ upright.T)
    figure = new_figure(PAGE_WIDTH, 4.8, columns=3)
    figure.axes[0].remove()
    space = figure.add_subplot(1, 3, 1, projection="3d")
    planes = [(figure.axes[0], (0, 1), "from above"), (figure.axes[1], (1, 2), "from the side")]
    for name, center, corners in zip(names, centers, frusta, strict=True):
        ring = np.concatenate([corners, corners[:1]])
        edges = [ring, *(np.stack([center, corner]) for corner in corners)]
        for line in edges:
            space.plot(*line.T, color=ACCENT, linewidth=0.8)
            for axis, plane, _ in planes:
                axis.plot(*line[:, plane].T, color=ACCENT, linewidth=0.8)
        space.text(*center, name, fontsize=7, color=INK)
        for axis, plane, _ in planes[:1]:  # from the side they would cover each other
            axis.annotate(
                name, center[list(plane)], fontsize=7, color=INK, xytext=(3, 3), textcoords="offset points"
            )
    for outline in outlines:
        ring = np.concatenate([outline, outline[:1]])
        space.plot(*ring.T, color=SOFT, linewidth=0.4, alpha=0.6)
        for axis, plane, _ in planes:
            axis.plot(*ring[:, plane].T, color=SOFT, linewidth=0.4, alpha=0.6)
    labels = ("right (m)", "towards the cameras (m)", "up (m)")
    for axis, plane, title in planes:
        axis.set_aspect("equal", adjustable="datalim")
        axis.set(xlabel=labels[plane[0]], ylabel=labels[plane[1]], title=title)
    space.set_aspect("equal")
    space.view_init(elev=22, azim=60)
    space.tick_params(labelsize=6)
    return figure


def photographs_in_space(
    names: Sequence[str], cameras: Sequence[Camera], camera_from_rig: Rigid, points: np.ndarray, unit: str
) -> Figure:
    """Where photographs were taken from, from above and from the side, and the points that they see.

    Args:
        names, cameras: C of them; names that would cover others are left out.
        camera_from_rig: C poses.
        points: [N, 3] in the rig's frame.
        unit: of length, for the axes.
    """
    middle = np.median(points, axis=0)
    upright = _upright(camera_from_rig, middle)
    centers = (camera_from_rig.inverse.translation - middle) @ upright.T
    cloud = (points[:: -(-len(points) // MAX_POINTS)] - middle) @ upright.T
    reach = 0.1 * float(np.median(np.linalg.norm(centers, axis=1)))
    figure = new_figure(PAGE_WIDTH, 5.4, columns=2)
    labels = (f"right ({unit})", f"towards the cameras ({unit})", f"up ({unit})")
    for axis, (across, along), title in zip(
        figure.axes, ((0, 1), (1, 2)), ("from above", "from the side"), strict=True
    ):
        axis.plot(cloud[:, across], cloud[:, along], ".", color=SOFT, markersize=1.5, alpha=0.5)
        for index, camera in enumerate(cameras):
            rays = _corner_rays(camera) * reach - camera_from_rig.translation[index]
            corners = (rays @ camera_from_rig.rotation[index] - middle) @ upright.T
            for line in (
                corners[[0, 1, 2, 3, 0]],
                *(np.stack([centers[index], corner]) for corner in corners),
            ):
                axis.plot(line[:, across], line[:, along], color=ACCENT, linewidth=0.6)
        axis.plot(centers[:, across], centers[:, along], "o", color=ACCENT, markersize=3)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set(xlabel=labels[across], ylabel=labels[along], title=title)
        shown = np.concatenate([cloud, centers])[:, along]
        for index in _apart(centers[:, (across, along)], NAME_DISTANCE * float(np.ptp(shown))):
            place = (centers[index, across], centers[index, along])
            axis.annotate(
                names[index], place, fontsize=7, color=INK, xytext=(4, 3), textcoords="offset points"
            )
    return figure


def _apart(places: np.ndarray, distance: float) -> list[int]:
    """Of places [N, 2], the first, and each further one that lies this far up or down, or thrice to the side."""
    kept: list[int] = []
    for index, place in enumerate(places):
        off = np.abs(places[kept] - place) / (3 * distance, distance)
        if (off.max(axis=1) >= 1).all():
            kept.append(index)
    return kept


@dataclass(frozen=True)
class _Cells:
    """Errors of one camera, gathered in square cells of the image."""

    side: float
    count: np.ndarray
    mean: np.ndarray
    rms: np.ndarray

    @property
    def enough(self) -> np.ndarray:
        return self.count >= MIN_IN_CELL

    @classmethod
    def of(cls, camera: CameraResiduals) -> "_Cells":
        width, height = camera.size
        side = max(width, height) / CELLS
        columns, rows = int(np.ceil(width / side)), int(np.ceil(height / side))
        place = np.clip((camera.pixels // side).astype(int), 0, (columns - 1, rows - 1))
        flat = place[:, 1] * columns + place[:, 0]
        count = np.bincount(flat, minlength=rows * columns)
        shared = np.maximum(count, 1)
        sums = [np.bincount(flat, camera.residuals[:, axis], rows * columns) for axis in range(2)]
        squares = np.bincount(flat, (camera.residuals**2).sum(axis=1), rows * columns)
        mean = np.stack(sums, axis=-1) / shared[:, None]
        shape = (rows, columns)
        rms = np.sqrt(squares / shared)
        return cls(side, count.reshape(shape), mean.reshape(*shape, 2), rms.reshape(shape))


def _panels(sizes: Sequence[tuple[int, int]]) -> tuple[Figure, list[Axes]]:
    """One panel per image; those that no image needs are removed."""
    rows = -(-len(sizes) // PANELS_PER_ROW)
    columns = -(-len(sizes) // rows)
    tallest = max(height / width for width, height in sizes)
    panel = min((PAGE_WIDTH - 1) / columns, LARGEST_PANEL)
    figure = new_figure(panel * columns + 1, (panel * tallest + 0.3) * rows, rows, columns)
    axes = list(figure.axes)
    for axis in axes[len(sizes) :]:
        axis.remove()
    return figure, axes[: len(sizes)]


def _image_axes(axis: Axes, name: str, width: int, height: int) -> None:
    axis.set_title(name, fontsize=9)
    axis.set_xlim(0, width)
    axis.set_ylim(height, 0)
    axis.set_aspect("equal")
    axis.grid(visible=False)
    axis.tick_params(labelsize=7)
    axis.locator_params(nbins=4)
    for spine in axis.spines.values():
        spine.set_visible(True)
        spine.set_color(SOFT)


def _twice_the_usual(values: np.ndarray) -> float:
    """The top of a scale on which an ordinary error has the middle colour, and a bad one the last."""
    known = values[np.isfinite(values)]
    return 2 * float(np.median(known)) or 1.0 if known.size else 1.0


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, 20 ... times a power of ten."""
    if value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-9)))


def _corner_rays(camera: Camera) -> np.ndarray:
    """Directions [4, 3] of the image's corners, depth 1; the nearest that the lens sees."""
    width, height = camera.width, camera.height
    middle, corners = (
        np.array([width, height]) / 2,
        np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * (width, height),
    )
    rays = np.ones((4, 3))
    for index, corner in enumerate(corners):
        for share in (1.0, 0.9, 0.75, 0.5, 0.0):
            normalised, seen = camera.unproject(middle + share * (corner - middle))
            if seen:
                rays[index, :2] = normalised
                break
    return rays


def _upright(camera_from_rig: Rigid, middle: np.ndarray) -> np.ndarray:
    """Rotation [3, 3] from the rig's frame to one to look at: right, towards the cameras, up."""
    up = -camera_from_rig.rotation[:, 1].mean(axis=0)
    towards = camera_from_rig.inverse.translation.mean(axis=0) - middle
    up = up / np.linalg.norm(up)
    towards = towards - up * (towards @ up)
    if np.linalg.norm(towards) < 1e-9:  # cameras all around
        towards = camera_from_rig.rotation[0, 2] - up * (camera_from_rig.rotation[0, 2] @ up)
    towards = towards / np.linalg.norm(towards)
    return np.stack([np.cross(towards, up), towards, up])
