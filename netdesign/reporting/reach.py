"""What the robot reaches: the viewing sphere coloured by the reason that rules a direction out."""

from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from netdesign.model.arrays import Floats
from netdesign.model.frames import sphere_directions
from netdesign.reporting import palette
from netdesign.reporting.drawing import draw_solids, frustum_lines
from netdesign.reporting.mesh import PartMesh
from netdesign.reporting.record import RunRecord
from netdesign.reporting.statics import CELL_EYE, STYLE, cell_solids, frame

# Okabe and Ito's colours, the free directions in the report's green.
COLOURS = {
    "free": palette.GOOD,
    "out of reach": "#999999",
    "joint limits": "#cc79a7",
    "the robot touches itself": "#e69f00",
    "the robot touches the part": "#d55e00",
    "the robot touches an obstacle": "#56b4e9",
    "the robot blocks the view": "#222222",
}


@dataclass(frozen=True, kw_only=True)
class Reach:
    """Why stations are refused ("free": they are not).

    viewpoints: (k, 2) rad, directions spread evenly over the admissible sphere; with a depth (k, 3), on shells in turn.
    """

    viewpoints: Floats
    reasons: tuple[str, ...]

    def shares(self) -> dict[str, float]:
        """Return the share of the sphere of every reason that occurs, the free one first."""
        return {name: self.reasons.count(name) / len(self.reasons) for name in COLOURS if name in self.reasons}


def reach_figure(record: RunRecord, mesh: PartMesh, reach: Reach) -> Figure | None:
    """Return the cell with the sphere around it, and the sphere from above; None without planned joints."""
    network = next(network for network in record.networks if network.id == record.knee)
    joints = network.planned.get("joints_rad")
    if record.arm is None or joints is None:
        return None
    sphere, poses = record.task.sphere, network.world_from_cam
    positions = sphere.centre + sphere.radii(reach.viewpoints)[:, None] * sphere_directions(reach.viewpoints)
    colours = np.array([COLOURS[reason] for reason in reach.reasons])
    with rc_context(STYLE):
        figure = Figure(figsize=(9.6, 5.2))
        left, right = figure.add_axes((0.0, 0.0, 0.54, 1.0)), figure.add_axes((0.55, 0.02, 0.44, 0.80))
        behind = CELL_EYE.nearness(positions) < CELL_EYE.nearness(sphere.centre)
        flat = CELL_EYE.flat(positions)
        left.scatter(flat[behind, 0], flat[behind, 1], s=4, c=colours[behind], alpha=0.35, linewidths=0)
        for group in cell_solids(record, mesh, np.array(joints[0])):
            draw_solids(left, CELL_EYE, group)
        left.scatter(flat[~behind, 0], flat[~behind, 1], s=4, c=colours[~behind], alpha=0.8, linewidths=0, zorder=3)
        frusta = frustum_lines(record.task.camera, poses, 0.12 * sphere.radius).reshape(-1, 2, 3)
        left.add_collection(LineCollection(list(CELL_EYE.flat(frusta)), colors="black", linewidths=0.7, zorder=4))
        left.plot(*CELL_EYE.flat(poses[:, :3, 3]).T, color="black", linewidth=1.0, zorder=4)
        frame(left)
        _from_above(right, reach, colours, poses[:, :3, 3] - sphere.centre)
        for name, share in reach.shares().items():
            right.scatter([], [], s=24, c=COLOURS[name], label=f"{name} {share:.1%}")
        right.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=7.5, handletextpad=0.2)
    return figure


def _from_above(axes: Axes, reach: Reach, colours: Floats, stations: Floats) -> None:
    """Draw the sphere from above in Lambert's equal-area projection, stations and tour on it."""
    x, y = _disc(sphere_directions(reach.viewpoints))
    axes.scatter(x, y, s=7, c=colours, linewidths=0)
    x, y = _disc(stations / np.linalg.norm(stations, axis=1, keepdims=True))
    axes.plot(x, y, color="black", linewidth=1.0)
    axes.scatter(x, y, s=16, color="white", edgecolors="black", linewidths=0.9, zorder=3)
    for number, (a, b) in enumerate(zip(x, y, strict=True), start=1):
        axes.annotate(str(number), (a, b), xytext=(4, 4), textcoords="offset points", fontsize=7.5)
    frame(axes)


def _disc(directions: Floats) -> tuple[Floats, Floats]:
    scale = np.sqrt(2.0 / np.maximum(1.0 + directions[:, 2], 1e-9))
    return directions[:, 0] * scale, directions[:, 1] * scale
