"""What the robot reaches: the viewing sphere coloured by the reason that rules a direction out."""

from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import sphere_directions, viewpoints_of
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


SHELLS = {0.0: "nearest stations", 0.5: "halfway", 1.0: "farthest stations"}  # by the share of the depth


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

    def shells(self) -> list[tuple[str, Bools]]:
        """Return the name of every shell, the nearest first, and its viewpoints (k,); a single one has no name."""
        depths = np.unique(self.viewpoints[:, 2:])
        if len(depths) < 2:
            return [("", np.ones(len(self.viewpoints), np.bool_))]
        return [(SHELLS.get(depth, f"{depth:.0%}"), self.viewpoints[:, 2] == depth) for depth in depths.tolist()]


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
        left = figure.add_axes((0.0, 0.0, 0.54, 1.0))
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
        above = _discs(figure, reach, colours, poses[:, :3, 3] - sphere.centre)
        for name, share in reach.shares().items():
            above.scatter([], [], s=24, c=COLOURS[name], label=f"{name} {share:.1%}")
        figure.legend(loc="lower center", bbox_to_anchor=(0.77, 0.82), ncols=2, fontsize=7.5, handletextpad=0.2)
    return figure


def _discs(figure: Figure, reach: Reach, colours: Floats, stations: Floats) -> Axes:
    """Draw the directions from above in Lambert's equal-area projection, stations and tour on them.

    Shells have a disc each, one over the other they would hide what the distance does; the tour has the last one.
    """
    shells = reach.shells()
    if len(shells) == 1:
        axes = figure.add_axes((0.55, 0.02, 0.44, 0.80))
        axes.scatter(*_disc(sphere_directions(reach.viewpoints)), s=7, c=colours, linewidths=0)
        _tour(axes, stations)
        frame(axes)
        return axes
    for number, (name, own) in enumerate([*shells, ("the tour", np.ones(len(colours), np.bool_))]):
        row, column = divmod(number, 2)
        axes = figure.add_axes((0.55 + 0.22 * column, 0.42 - 0.41 * row, 0.21, 0.36))
        x, y = _disc(sphere_directions(reach.viewpoints[own]))
        if number < len(shells):
            axes.scatter(x, y, s=4, c=colours[own], linewidths=0)
        else:
            axes.scatter(x, y, s=1, c="#dddddd", linewidths=0)
            _tour(axes, stations)
        axes.set_title(name, fontsize=7.5, pad=2)
        frame(axes)
    return axes


def _tour(axes: Axes, stations: Floats) -> None:
    x, y = _disc(sphere_directions(viewpoints_of(stations)))
    axes.plot(x, y, color="black", linewidth=1.0)
    axes.scatter(x, y, s=16, color="white", edgecolors="black", linewidths=0.9, zorder=3)
    for number, (a, b) in enumerate(zip(x, y, strict=True), start=1):
        axes.annotate(str(number), (a, b), xytext=(4, 4), textcoords="offset points", fontsize=7.5)


def _disc(directions: Floats) -> tuple[Floats, Floats]:
    scale = np.sqrt(2.0 / np.maximum(1.0 + directions[:, 2], 1e-9))
    return directions[:, 0] * scale, directions[:, 1] * scale
