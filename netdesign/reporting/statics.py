"""The figures that need no browser: RUN/figures/*.png, and what a printed report shows."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image

from netdesign.errors import InputError
from netdesign.model.arrays import Floats
from netdesign.model.figures import significant
from netdesign.photogrammetry.bvh import TriangleTree
from netdesign.reporting import palette
from netdesign.reporting.arm import box_mesh
from netdesign.reporting.drawing import View, draw_ellipsoids, draw_part, draw_solids, draw_tags, frustum_lines
from netdesign.reporting.mesh import PartMesh, hidden
from netdesign.reporting.proof import scatter
from netdesign.reporting.record import NetworkRecord, RunRecord

STYLE: Any = {
    "font.family": "DejaVu Sans", "font.size": 8.5, "axes.titlesize": 9.5, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": "#55585c",
    "axes.labelcolor": "#33363a", "xtick.color": "#55585c", "ytick.color": "#55585c", "axes.grid": True,
    "grid.color": "#e4e4e0", "grid.linewidth": 0.7, "axes.axisbelow": True, "legend.frameon": False,
    "figure.facecolor": "white", "savefig.facecolor": "white",
}  # fmt: skip
EYE = View(azimuth=np.radians(-52.0), elevation=np.radians(28.0))
CELL_EYE = View(azimuth=np.radians(-62.0), elevation=np.radians(24.0))
DARK_TAG, PALE_TAG = "#3a3c40", "#b9b8b4"  # opaque: tags are drawn in pieces that overlap at their seams


@dataclass(frozen=True, kw_only=True)
class Raster:
    """A drawn figure, (h, w, 3) uint8, at ``dpi``: drawn once, encoded as often as it is needed."""

    pixels: NDArray[np.uint8]
    dpi: int

    @classmethod
    def of(cls, figure: Figure, dpi: int) -> "Raster":
        """Draw a figure."""
        figure.set_dpi(dpi)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()  # type: ignore[no-untyped-call]
        pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        return cls(pixels=pixels[..., :3].copy(), dpi=dpi)

    def png(self) -> bytes:
        """Return the PNG file."""
        return self._encoded(Image.fromarray(self.pixels), "PNG", dpi=(self.dpi, self.dpi))

    def webp(self, width: int) -> bytes:
        """Return a WebP of the given width in pixels."""
        image = Image.fromarray(self.pixels)
        size = width, round(image.height * width / image.width)
        return self._encoded(image.resize(size, Image.Resampling.LANCZOS), "WEBP", quality=84, method=4)

    @staticmethod
    def _encoded(image: Image.Image, kind: str, **options: Any) -> bytes:
        buffer = io.BytesIO()
        image.save(buffer, kind, **options)
        return buffer.getvalue()


def thumbnail(path: Path, width: int = 320) -> bytes:
    """Return a photo as a small grey JPEG.

    Raises:
        InputError: the file is not an image.
    """
    buffer = io.BytesIO()
    try:
        with Image.open(path) as image:
            size = width, round(image.height * width / image.width)
            image.convert("L").resize(size, Image.Resampling.LANCZOS).save(buffer, "JPEG", quality=80)
    except OSError as error:
        raise InputError(f"{path}: expected an image, found {error}") from None
    return buffer.getvalue()


def front_figure(record: RunRecord) -> Figure:
    """Return the front as figure 5 of the source shows it: the layered cloud and its three projections."""
    networks = record.networks
    images = np.array([network.images for network in networks])
    tour = np.array([network.tour for network in networks])
    sigma = np.array([record.precision_um(network) for network in networks])
    colors = palette.ordered(images)
    unit = record.tour_unit
    names = {"sigma": f"{record.precision_name} [µm]", "tour": f"tour [{unit}]", "images": "images"}
    knee = next(index for index, network in enumerate(networks) if network.id == record.knee)
    with rc_context(STYLE):
        figure = Figure(figsize=(9.6, 7.4), layout="constrained")
        cloud = figure.add_subplot(2, 2, 1, projection="3d")
        cloud.computed_zorder = False
        for size in np.unique(images):
            rows = np.flatnonzero(images == size)
            rows = rows[np.argsort(tour[rows])]
            cloud.plot(tour[rows], np.full(len(rows), size), sigma[rows], color=colors[rows[0]], linewidth=0.9)
        cloud.scatter(tour, images, sigma, c=colors, s=18, depthshade=False)
        cloud.set(xlabel=names["tour"], ylabel=names["images"], zlabel=names["sigma"], title="All three, in layers")
        cloud.view_init(elev=22, azim=-58)
        cloud.set_box_aspect(None, zoom=0.98)
        motion, count, displacement = (figure.add_subplot(2, 2, index) for index in (2, 3, 4))
        for size in np.unique(images):
            rows = np.flatnonzero(images == size)
            rows = rows[np.argsort(tour[rows])]
            motion.plot(tour[rows], sigma[rows], color=colors[rows[0]], linewidth=1.1)
            motion.annotate(
                str(size), (tour[rows[0]], sigma[rows[0]]), xytext=(-3, 4), textcoords="offset points",
                ha="right", color=colors[rows[0]], fontsize=7.5,
            )  # fmt: skip
        motion.scatter(tour, sigma, c=colors, s=20, zorder=3)
        motion.set(xlabel=names["tour"], ylabel=names["sigma"], title="Precision and motion (curves: images)")
        count.scatter(images, sigma, c=colors, s=20, zorder=3)
        bound = record.bounds_um()
        if bound:
            count.plot(*zip(*bound, strict=True), color=palette.BOUND, linewidth=1.2, linestyle=(0, (4, 2)),
                       marker="_", label="proven lower bound")  # fmt: skip
            count.legend(loc="upper right")
        count.set(xlabel=names["images"], ylabel=names["sigma"], title="Precision and images")
        displacement.scatter(images, tour, c=colors, s=20, zorder=3)
        displacement.set(xlabel=names["images"], ylabel=names["tour"], title="Motion and images")
        for axes, x, y in ((motion, tour, sigma), (count, images, sigma), (displacement, images, tour)):
            axes.scatter(x[knee], y[knee], s=120, facecolors="none", edgecolors=palette.ACHIEVED, linewidths=1.4,
                         zorder=4)  # fmt: skip
            if x is images:
                axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def network_figure(record: RunRecord, network: NetworkRecord, mesh: PartMesh) -> Figure:
    """Return one network: its stations and tour around the part, and the uncertainty of the object points."""
    with rc_context(STYLE):
        figure = Figure(figsize=(9.6, 4.5))
        left, right = figure.add_axes((0.01, 0.01, 0.48, 0.92)), figure.add_axes((0.51, 0.01, 0.48, 0.92))
        _stations(left, record, network, mesh)
        factor = _ellipsoids(right, record, network, mesh)
        _title(
            left,
            f"Network {network.name}: {network.images} images, tour {significant(network.tour)} {record.tour_unit}",
        )
        _title(right, f"1-sigma ellipsoids × {factor:,.0f}".replace(",", " ") + ", total propagation")
    return figure


def achieved_figure(record: RunRecord) -> Figure | None:
    """Return achieved rms error against predicted rms sigma of every proved network; None when there is none."""
    proved = [(network, found) for network in record.networks if (found := scatter(network)) is not None]
    if not proved:
        return None
    predicted = np.array([found["predicted"] for _, found in proved])
    achieved = np.array([found["achieved"] for _, found in proved])
    passed = np.array([found["pass"] for _, found in proved])
    colors = np.array(palette.ordered(network.images for network, _ in proved))
    low, high = min(predicted.min(), achieved.min()) / 1.15, max(predicted.max(), achieved.max()) * 1.15
    with rc_context(STYLE):
        figure = Figure(figsize=(5.6, 5.0), layout="constrained")
        axes = figure.add_subplot()
        line = np.array([low, high])
        axes.fill_between(line, 0.9 * line, 1.1 * line, color="#dfe7ec", linewidth=0, label="± 10 %")
        axes.plot(line, line, color=palette.BOUND, linewidth=1.1, linestyle=(0, (4, 2)), label="equal")
        axes.scatter(predicted[passed], achieved[passed], c=colors[passed], s=28, zorder=3)
        axes.scatter(predicted[~passed], achieved[~passed], c=palette.BAD, s=36, marker="x", zorder=3,
                     label="outside its own intervals")  # fmt: skip
        if high / low > 4:
            axes.set(xscale="log", yscale="log")
        axes.set(xlim=(low, high), ylim=(low, high), xlabel="predicted rms sigma [µm]",
                 ylabel="achieved rms error [µm]", title="Achieved against predicted (P2)")  # fmt: skip
        axes.set_aspect("equal")
        axes.legend(loc="upper left")
    return figure


def cell_figure(record: RunRecord, mesh: PartMesh) -> Figure | None:
    """Return the robot at the first station of the recommended network; None without a robot."""
    network = next(network for network in record.networks if network.id == record.knee)
    joints = network.planned.get("joints_rad")
    if record.arm is None or joints is None:
        return None
    poses = network.world_from_cam
    groups = cell_solids(record, mesh, np.array(joints[0]))
    with rc_context(STYLE):
        figure = Figure(figsize=(9.6, 6.0))
        axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
        for group in groups:
            draw_solids(axes, CELL_EYE, group)
        targets = record.task.scene.targets
        everything = TriangleTree.build(
            np.concatenate([vertices[faces] for group in groups for vertices, faces, _ in group])
        )
        draw_tags(axes, CELL_EYE, everything, targets.points.reshape(-1, 4, 3), np.asarray(targets.normals), DARK_TAG)
        frusta = frustum_lines(record.task.camera, poses, 0.12 * record.task.sphere.radius)
        first = frustum_lines(record.task.camera, poses[:1], 0.8 * record.task.sphere.radius)
        for lines, color, width in ((frusta, palette.PREDICTED_TOTAL, 0.7), (first, palette.ACHIEVED, 0.9)):
            axes.add_collection(LineCollection(list(CELL_EYE.flat(lines.reshape(-1, 2, 3))), colors=color,
                                               linewidths=width))  # fmt: skip
        flat = CELL_EYE.flat(poses[:, :3, 3])
        axes.plot(*flat.T, color=palette.TOUR, linewidth=1.2)
        for number, (x, y) in enumerate(flat, start=1):
            axes.annotate(str(number), (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7.5)
        frame(axes)
    return figure


def cell_solids(record: RunRecord, mesh: PartMesh, joints: Floats) -> list[list[Any]]:
    """Return what ``draw_solids`` takes of table, arm at joints (r,) and part, what stands behind or below first.

    Raises:
        ValueError: the run has no robot.
    """
    if record.arm is None:
        raise ValueError("expected a run with a robot")
    table = [(*box_mesh(centre, size, steps=24), (0.78, 0.76, 0.72)) for centre, size in record.arm.obstacles]
    part = [(mesh.vertices, mesh.faces, (0.93, 0.92, 0.89))]
    body = [(vertices, faces, (0.62, 0.70, 0.76)) for vertices, faces in record.arm.posed(joints)]
    # The painter's order of large triangles errs where things stand on one another: what stands below comes first.
    hand = CELL_EYE.nearness(np.concatenate([vertices for vertices, _, _ in body[-2:]])).mean()
    return [table, part, body] if hand > CELL_EYE.nearness(mesh.vertices).mean() else [table, body, part]


def exaggeration(record: RunRecord, covariance: Floats) -> float:
    """Return the factor, 1, 2 or 5 times a power of ten, that draws a typical semi-axis 0.4 of a tag's edge long."""
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3)
    typical = float(np.median(sigma[np.isfinite(sigma)])) if np.isfinite(sigma).any() else 0.0
    if typical <= 0:
        return 1.0
    wanted = 0.4 * record.task.scene.targets.size_m / typical
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted * (1 + 1e-9)))


def _stations(axes: Axes, record: RunRecord, network: NetworkRecord, mesh: PartMesh) -> None:
    targets, camera = record.task.scene.targets, record.task.camera
    centres = network.world_from_cam[:, :3, 3]
    frusta = frustum_lines(camera, network.world_from_cam, 0.16 * record.task.sphere.radius)
    behind = EYE.nearness(centres) < EYE.nearness(record.task.sphere.centre)
    color = palette.PREDICTED_TOTAL
    axes.add_collection(
        LineCollection(list(EYE.flat(frusta[behind].reshape(-1, 2, 3))), colors=color + "66", linewidths=0.6)
    )
    draw_part(axes, EYE, mesh)
    draw_tags(axes, EYE, mesh.tree, targets.points.reshape(-1, 4, 3), np.asarray(targets.normals), DARK_TAG)
    axes.add_collection(LineCollection(list(EYE.flat(frusta[~behind].reshape(-1, 2, 3))), colors=color, linewidths=0.7))
    flat = EYE.flat(centres)
    axes.plot(*flat.T, color=palette.TOUR, linewidth=1.3, zorder=3)
    axes.scatter(flat[:, 0], flat[:, 1], s=14, color=color, zorder=4)
    for number, (x, y) in enumerate(flat, start=1):
        axes.annotate(str(number), (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7.5, zorder=5)
    frame(axes)


def _ellipsoids(axes: Axes, record: RunRecord, network: NetworkRecord, mesh: PartMesh) -> float:
    targets = record.task.scene.targets
    points, normals = targets.points, targets.point_normals
    factor = exaggeration(record, network.total)
    draw_part(axes, EYE, mesh)
    finite = np.isfinite(network.total).all(axis=(1, 2))
    front = (normals @ EYE.axes[2] > 0.02) & finite
    front[front] = ~hidden(mesh.tree, points[front], EYE.axes[2])
    draw_tags(axes, EYE, mesh.tree, points.reshape(-1, 4, 3), np.asarray(targets.normals), PALE_TAG)
    draw_ellipsoids(axes, EYE, points, network.total, factor, palette.PREDICTED_TOTAL, front)
    frame(axes)
    if not finite.any():
        axes.text(0.5, 0.5, "not determined", transform=axes.transAxes, ha="center", color=palette.BAD)
    return factor


def _title(axes: Axes, text: str) -> None:
    # Not set_title: placing that measures every tick of axes that are not even drawn.
    axes.text(0.0, 1.02, text, transform=axes.transAxes, fontsize=9.5, fontweight="bold")


def frame(axes: Axes) -> None:
    """Leave nothing but the drawing, undistorted."""
    axes.autoscale_view()
    axes.margins(0.03)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_axis_off()
