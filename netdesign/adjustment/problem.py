"""A bundle adjustment to be solved: observations, approximations, what is free, and what carries the datum."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from netdesign.errors import InfeasibleError, InputError
from netdesign.model.adjustment import ControlPoints, Datum, PosePriors, ScaleBars
from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.network import Observations
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.connectivity import listed, named, structure_complaints
from netdesign.photogrammetry.datum import point_null_space, pose_null_space
from netdesign.photogrammetry.observation_equations import Layout, parameter_matrix


@dataclass(frozen=True, kw_only=True)
class BundleProblem:
    """Everything a bundle adjustment starts from. Metres (or any one unit of length), radians, pixels.

    Attributes:
        observations: image points.  camera_of_image: (n,) row of ``intrinsics`` (c, 8).
        world_from_cam: (n, 4, 4), points: (m, 3): approximate values; the free datum is anchored on these points.
        refine: interior parameters to estimate, the same ones for every camera.
        datum: "free" inner constraints (7; control, bars and priors unused); "scale" inner constraints (6) and scale
            bars; "control" control points with their weights; "fixed" all control points error-free; "poses" pose
            priors with their weights. Scale bars join every datum but "free", pose priors join control points.
        datum_points: (m,) points that carry the inner constraints, None for all.
    """

    observations: Observations
    camera_of_image: Ints
    intrinsics: Floats
    world_from_cam: Floats
    points: Floats
    image_names: Sequence[str]
    point_names: Sequence[str]
    refine: tuple[str, ...] = ()
    datum: Datum = "free"
    datum_points: Bools | None = None
    control: ControlPoints | None = None
    bars: ScaleBars | None = None
    priors: PosePriors | None = None

    @property
    def active_control(self) -> ControlPoints | None:
        """Control points as far as the datum uses them; "fixed" makes all of them error-free."""
        if self.control is None or self.datum not in ("control", "fixed"):
            return None
        return self.control if self.datum == "control" else replace(self.control, sigma=np.zeros(len(self.control.xyz)))

    @property
    def active_bars(self) -> ScaleBars | None:
        """Scale bars as far as the datum uses them."""
        return None if self.datum == "free" or self.bars is None or len(self.bars.a) == 0 else self.bars

    @property
    def active_priors(self) -> PosePriors | None:
        """Pose priors as far as the datum uses them."""
        return self.priors if self.datum in ("poses", "control", "fixed") else None

    def visible(self) -> Bools:
        """Return (n, m): which image observes which point."""
        table = np.zeros((len(self.world_from_cam), len(self.points)), dtype=np.bool_)
        table[self.observations.image, self.observations.point] = True
        return table

    def rays(self) -> Ints:
        """Return (m,): image points per object point."""
        return np.bincount(self.observations.point, minlength=len(self.points)).astype(np.int64)

    def known(self) -> Bools:
        """Return (m,): points with control coordinates that the datum uses, known along all axes."""
        mask = np.zeros(len(self.points), dtype=np.bool_)
        if self.active_control is not None:
            mask[self.active_control.point[self.active_control.whole]] = True
        return mask

    def layout(self) -> Layout:
        """Return which unknown stands where. Unobserved points without control are no unknowns."""
        observed = np.zeros(len(self.points), dtype=np.bool_)
        observed[self.observations.point] = True
        fixed, kept = np.zeros_like(observed), np.zeros_like(observed)
        control = self.active_control
        if control is not None:
            fixed[control.point[control.exact]] = True
        if self.active_bars is not None:
            kept[self.active_bars.a], kept[self.active_bars.b] = True, True
        kept &= observed & ~fixed
        return Layout(
            images=len(self.world_from_cam),
            camera_of_image=self.camera_of_image,
            parameters=tuple(parameter_matrix(self.refine, row) for row in self.intrinsics),
            kept=kept,
            eliminated=observed & ~fixed & ~kept,
        )

    def middle(self) -> Floats:
        """Return (3,) the median of the observed points: a few absurd approximate values do not move it."""
        return np.asarray(np.median(self.points[self.rays() > 0], axis=0))

    def normalised(self) -> tuple["BundleProblem", float, Floats]:
        """Return the same problem in units of the points' extent about their middle, the unit and the middle.

        Then no threshold and no rounding depends on the unit of length or on the origin: national coordinates of
        5 000 km cost nothing.
        """
        centre = self.middle()
        unit = float(np.median(np.linalg.norm(self.points[self.rays() > 0] - centre, axis=1)))
        if not (np.isfinite(unit) and unit > 0):
            raise InfeasibleError("object points: all at one place, nothing to adjust")
        poses = _rescaled(self.world_from_cam, centre, unit)
        control, bars, priors = self.control, self.bars, self.priors
        if control is not None:
            control = replace(control, xyz=(control.xyz - centre) / unit, sigma=control.sigma / unit)
        if bars is not None:
            bars = replace(bars, length=bars.length / unit, sigma=bars.sigma / unit)
        if priors is not None:
            priors = replace(
                priors,
                world_from_cam=_rescaled(priors.world_from_cam, centre, unit),
                sigma_position=np.asarray(priors.sigma_position) / unit,
            )
        points = (self.points - centre) / unit
        return (
            replace(self, world_from_cam=poses, points=points, control=control, bars=bars, priors=priors),
            unit,
            centre,
        )


def _rescaled(poses: Floats, centre: Floats, unit: float) -> Floats:
    result = poses.copy()
    result[:, :3, 3] = (result[:, :3, 3] - centre) / unit
    return result


def null_space(problem: BundleProblem, layout: Layout) -> tuple[Floats, Floats]:
    """Return (G_c (W, d), G_p (3m, d)): the datum parameters that nothing measured or fixed determines."""
    centre = problem.middle()
    g_points = point_null_space(problem.points, centre)
    rows = g_points.reshape(-1, 3, 7)
    g_camera = np.zeros((layout.width, 7))
    g_camera[: 6 * layout.images] = pose_null_space(problem.world_from_cam, centre)
    g_camera[int(layout.parameter_start[-1]) :] = rows[layout.kept].reshape(-1, 7)
    known: list[Floats] = []
    if problem.active_control is not None:
        known.append(rows[problem.active_control.point][np.isfinite(problem.active_control.sigma)])
    bars = problem.active_bars
    if bars is not None:
        direction = problem.points[bars.a] - problem.points[bars.b]
        direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        known.append(np.einsum("bi,big->bg", direction, rows[bars.a] - rows[bars.b]))
    if problem.active_priors is not None:
        image, position, rotation = problem.active_priors.weights
        per_image = g_camera[: 6 * layout.images].reshape(-1, 6, 7)
        known.append(per_image[image[rotation > 0], :3].reshape(-1, 7))
        known.append(per_image[image[position > 0], 3:].reshape(-1, 7))
    known.append(np.zeros((7, 7)))  # so that the decomposition always has seven right vectors
    _, singular, right = np.linalg.svd(np.vstack(known), full_matrices=False)
    rank = int((singular > 1e-9 * max(1.0, singular.max(initial=0.0))).sum())
    open_ = right[rank:].T
    fixed = ~(layout.eliminated | layout.kept)
    g_points = g_points.copy()
    g_points[np.repeat(fixed, 3)] = 0.0
    return g_camera @ open_, g_points @ open_


def check_input(problem: BundleProblem) -> None:
    """Raise on values that are no numbers, on indices that do not fit and on a datum without what carries it.

    Raises:
        InputError: naming the image, point, control point or bar.
    """
    names, images = problem.point_names, problem.image_names
    observations = problem.observations
    bad = ~(np.isfinite(observations.xy_px).all(axis=1) & np.isfinite(observations.covariance).all(axis=(1, 2)))
    if bad.any():
        k = int(np.argmax(bad))
        raise InputError(
            f"observation of point {names[observations.point[k]]} in image {images[observations.image[k]]}: "
            "expected finite numbers, found NaN or infinity"
        )
    for what, array in (("poses", problem.world_from_cam), ("points", problem.points)):
        broken = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
        if len(broken):
            who = images[broken[0]] if what == "poses" else names[broken[0]]
            raise InputError(f"{what}: expected finite approximate values, found NaN or infinity for {who}")
    pair = observations.image * len(problem.points) + observations.point
    if len(np.unique(pair)) != len(pair):
        values, counts = np.unique(pair, return_counts=True)
        image, point = divmod(int(values[np.argmax(counts > 1)]), len(problem.points))
        raise InputError(f"point {names[point]} is observed twice in image {images[image]}")
    if problem.datum in ("control", "fixed") and (problem.control is None or len(problem.control.point) == 0):
        raise InputError(f"datum {problem.datum}: expected control points, found none")
    if problem.datum == "fixed" and problem.control is not None and not problem.control.whole.all():
        partly = np.unique(problem.control.point[~problem.control.whole])
        raise InputError(
            f"datum fixed: expected control points known along all axes, found an empty sigma for "
            f"{listed(named(names, partly))}; datum control takes them"
        )
    if problem.datum == "scale" and (problem.bars is None or len(problem.bars.a) == 0):
        raise InputError("datum scale: expected scale bars, found none")
    if problem.datum == "poses" and (problem.priors is None or len(problem.priors.world_from_cam) == 0):
        raise InputError("datum poses: expected pose priors, found none")
    observed = problem.rays() > 0
    for what, index in (
        ("control point", None if problem.active_control is None else problem.active_control.point),
        ("scale bar end", None if problem.active_bars is None else np.r_[problem.active_bars.a, problem.active_bars.b]),
    ):
        unseen = [] if index is None else named(names, np.unique(index[~observed[index]]))
        if unseen:
            raise InfeasibleError(f"{len(unseen)} {what}(s) are observed in no image: {listed(unseen)}")
    if problem.datum_points is not None and problem.datum in ("free", "scale"):
        missing = named(names, problem.datum_points & ~observed)
        if missing:
            raise InfeasibleError(f"{len(missing)} datum point(s) are observed in no image: {listed(missing)}")


def _dependent_bars(problem: BundleProblem) -> int:
    """Return how many error-free bars, of those that are not between fixed points, say what others say already."""
    bars, layout = problem.active_bars, problem.layout()
    if bars is None or not (bars.sigma == 0).any():
        return 0
    exact = bars.sigma == 0
    a, b = bars.a[exact], bars.b[exact]
    direction = problem.points[b] - problem.points[a]
    rows = np.zeros((len(a), len(problem.points), 3))
    rows[np.arange(len(a)), a], rows[np.arange(len(a)), b] = -direction, direction
    flat = rows[:, layout.kept].reshape(len(a), -1)
    length = np.linalg.norm(flat, axis=1)
    flat = flat[length > 0] / length[length > 0, None]
    return len(flat) - int(np.linalg.matrix_rank(flat, tol=1e-9)) if flat.size else 0


def check_start(problem: BundleProblem) -> None:
    """Raise on what no adjustment can repair: missing rays, loose blocks, an open datum, points behind their camera.

    Raises:
        InfeasibleError: naming the images and points.
    """
    visible = problem.visible()
    seen = problem.rays() > 0
    complaints = structure_complaints(
        visible[:, seen], problem.image_names, named(problem.point_names, seen), problem.known()[seen]
    )
    if complaints:
        raise InfeasibleError("; ".join(complaints))
    open_ = null_space(problem, problem.layout())[0].shape[1]
    if open_ and problem.datum == "poses":
        raise InfeasibleError(
            f"datum poses: the pose priors leave {open_} of 7 datum parameters open; expected more of them, or bars"
        )
    if open_ and problem.datum in ("control", "fixed") and problem.control is not None:
        raise InfeasibleError(
            f"datum {problem.datum}: {len(problem.control.point)} control point(s) leave {open_} of 7 datum "
            "parameters open; expected at least 3 that do not lie on one line"
        )
    dependent = _dependent_bars(problem)
    if dependent:
        raise InfeasibleError(
            f"{dependent} of the error-free scale bars follow from the others, or contradict them: give them a sigma"
        )
    observations = problem.observations
    _, depth = project(
        problem.world_from_cam[observations.image],
        problem.points[observations.point],
        problem.intrinsics[problem.camera_of_image[observations.image]],
    )
    behind = np.flatnonzero(~(depth > 0))
    if len(behind):
        pairs = zip(
            named(problem.point_names, observations.point[behind]),
            named(problem.image_names, observations.image[behind]),
            strict=True,
        )
        where = [f"point {point} in image {image}" for point, image in pairs]
        raise InfeasibleError(f"{len(behind)} image point(s) lie behind their camera at the start: {listed(where)}")
