"""What an adjustment cannot determine, and what its user should know, in words."""

import numpy as np
from scipy.stats import chi2

from netdesign.adjustment.problem import BundleProblem
from netdesign.model.adjustment import Adjustment
from netdesign.model.arrays import Bools, Floats
from netdesign.photogrammetry.connectivity import listed, named, tie_flags
from netdesign.photogrammetry.normals import Reduced
from netdesign.photogrammetry.observation_equations import Layout

POINT_CONDITION = 1e-9  # of a point's normals: below it its rays are parallel
HOPELESS_DEPTH = 0.2  # sigma over distance above which a point counts as not determined
HOPELESS_SHARE = 0.1  # of the points: so many are no stray points, but a network without a base
HOPELESS_NETWORK = 0.05  # median inner sigma over the object's extent above which nothing is determined
WEAK_DEPTH = 0.01  # sigma over distance above which its ray geometry is named
HARDLY_CHECKED = 0.1  # redundancy number below which a gross error hardly shows in the residual
SHARE_HARDLY_CHECKED = 0.05  # of the image points; a few at the end of a three-ray point are in every network
CLOSE_BASELINE = 0.01
MOST_GROUPS = 3  # of loosely tied images that are named; a project of a hundred images has many
CORRELATION = 0.95
# Effects of a parameter's sigma in the image. That it is large is a warning; that it moves the edge of the field by a
# tenth of its radius is no estimate any more. A flat object seen without roll is singular for the principal point,
# and only the noise of the estimates hides it: there the sigma that one image point would give is what shows it.
WEAK_PARAMETER = 100.0  # in sigmas of one image coordinate
NOT_DETERMINED = 0.1  # of the field's radius
NOT_DETERMINED_FLAT = 600.0  # in sigmas of one image coordinate, times the root of the number of image points
ROLL_ALIKE = 0.97  # mean resultant length of the roll angles above which all images are rolled alike


def undetermined_points(layout: Layout, reduced: Reduced, weakness: Floats) -> Bools:
    """Return (m,) the points whose rays are so nearly parallel that their distance is noise.

    Args:
        weakness: (m,) of ``depth_weakness``.
    """
    parallel = (reduced.point_condition < POINT_CONDITION) | (weakness > HOPELESS_DEPTH)
    return np.asarray(layout.eliminated & parallel)


def point_complaints(problem: BundleProblem, layout: Layout, lost: Bools) -> tuple[str, ...]:
    """Return a complaint when more than stray points are not determined.

    Two images at one position and nothing else is the common cause.
    """
    if lost.sum() <= HOPELESS_SHARE * layout.eliminated.sum():
        return ()
    images = np.unique(problem.observations.image[lost[problem.observations.point]])
    return (
        f"{int(lost.sum())} point(s) have (nearly) parallel rays, their distance is not determined: "
        f"{listed(named(problem.point_names, lost))}; they are seen by images "
        f"{listed(named(problem.image_names, images))} only, from (nearly) one position",
        *coinciding_images(problem),
    )


def network_complaints(
    problem: BundleProblem, layout: Layout, shape: Floats, lost: Bools, noise: float
) -> tuple[str, ...]:
    """Return a complaint when the points are known no better than to a share of the object itself.

    Args:
        shape: (m, 3, 3) covariance over 7 inner constraints, in units of the object's extent.  noise: factor on sigma.
    """
    judged = (layout.eliminated | layout.kept) & ~lost
    if judged.sum() < 3:
        return ()
    worst = np.sqrt(np.maximum(np.linalg.eigvalsh(shape[judged])[:, -1], 0.0)) * noise
    typical = float(np.median(worst))
    if typical <= HOPELESS_NETWORK:
        return ()
    return (
        f"the network is not determined: half of the points have a sigma above {100 * typical:.0f} % of the object's "
        "extent",
        *coinciding_images(problem),
    )


def depth_weakness(problem: BundleProblem, layout: Layout, reduced: Reduced) -> Floats:
    """Return (m,): largest limited sigma of each point over its distance to the nearest image that sees it."""
    observations = problem.observations
    ray = problem.points[observations.point] - problem.world_from_cam[observations.image, :3, 3]
    distance = np.full(len(problem.points), np.inf)
    np.minimum.at(distance, observations.point, np.linalg.norm(ray, axis=1))
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(reduced.inverse)[:, -1], 0.0))
    return np.where(layout.eliminated, spread / distance, 0.0)


def coinciding_images(problem: BundleProblem) -> tuple[str, ...]:
    """Return pairs of images whose baseline is below CLOSE_BASELINE of their distance to the points.

    Harmless among others; in a network that fails they are the first suspects.
    """
    position = problem.world_from_cam[:, :3, 3]
    distance = np.linalg.norm(position - problem.points.mean(axis=0), axis=1)
    baseline = np.linalg.norm(position[:, None] - position[None], axis=2)
    close = np.triu(baseline < CLOSE_BASELINE * np.minimum(distance[:, None], distance[None]), 1)
    names = problem.image_names
    pairs = [f"{names[i]} and {names[j]}" for i, j in np.argwhere(close).tolist()]
    return (f"images (nearly) at one position: {listed(pairs)}",) if pairs else ()


def rolls_alike(poses: Floats) -> bool:
    """Tell whether all images (n, 4, 4) are rolled alike.

    Two ways to be alike: the smallest rotation to the mean viewing direction leaves the same x axis everywhere, or
    the mean direction stands at the same angle in every image (cameras held upright around the object).
    """
    axes = poses[:, :3, 2]
    mean = axes.sum(axis=0)
    length = float(np.linalg.norm(mean))
    if length < 0.1 * len(axes):
        return False
    mean = mean / length
    x_axes = poses[:, :3, 0]
    half = axes + mean
    carried = x_axes - (np.einsum("ni,ni->n", x_axes, half) / (1.0 + axes @ mean))[:, None] * half
    angle = np.arctan2(np.cross(carried[0], carried) @ mean, carried @ carried[0])
    upright = np.arctan2(poses[:, :3, 1] @ mean, x_axes @ mean)
    return bool(max(abs(np.exp(1j * angle).mean()), abs(np.exp(1j * upright).mean())) > ROLL_ALIKE)


def _is_flat(points: Floats) -> bool:
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(singular[2] < 0.02 * singular[0])


def _advice(problem: BundleProblem) -> str:
    cures = []
    if rolls_alike(problem.world_from_cam):
        cures.append("take some images with the camera rolled by 90°")
    if _is_flat(problem.points[np.unique(problem.observations.point)]):
        cures.append("the object is flat: add targets in depth or strongly convergent images")
    return "; advice: " + ", ".join(cures or ["hold the parameter or add images"])


def parameter_effect(problem: BundleProblem, sigma: Floats) -> Floats:
    """Return the effect (p,) px of one sigma of each free parameter at the edge of the image points' field.

    Args:
        sigma: (p,) in the parameters' own units, camera by camera.
    """
    observations = problem.observations
    camera = problem.camera_of_image[observations.image]
    effects: list[float] = []
    for index, intrinsics in enumerate(problem.intrinsics):
        focal = float(np.sqrt(intrinsics[0] * intrinsics[1]))
        rows = camera == index
        offset = (observations.xy_px[rows] - intrinsics[2:4]) / focal
        radius = float(np.sqrt((offset**2).sum(axis=1).max(initial=0.0)))
        by_name = {
            "f": radius, "fx": radius, "fy": radius, "cx": 1.0, "cy": 1.0, "k1": focal * radius**3,
            "k2": focal * radius**5, "p1": 3 * focal * radius**2, "p2": 3 * focal * radius**2,
        }  # fmt: skip
        effects.extend(by_name[name] for name in problem.refine)
    return np.array(effects) * sigma


def _field_radius(problem: BundleProblem) -> float:
    """Return the largest distance of an image point from its principal point, px."""
    observations = problem.observations
    centre = problem.intrinsics[problem.camera_of_image[observations.image], 2:4]
    return float(np.sqrt(((observations.xy_px - centre) ** 2).sum(axis=1).max()))


def _noise_px(problem: BundleProblem) -> float:
    return float(np.sqrt(np.median(problem.observations.covariance[:, [0, 1], [0, 1]])))


def calibration_complaints(
    problem: BundleProblem, parameter_names: tuple[str, ...], covariance: Floats | None
) -> tuple[str, ...]:
    """Return the interior parameters that the network does not determine, with a cure.

    Args:
        covariance: (p, p) a priori; None when the normal equations are singular: the advice alone comes back then.
    """
    if not parameter_names:
        return ()
    if covariance is None:
        return (_advice(problem)[2:],)
    effect = parameter_effect(problem, np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    bad = effect > NOT_DETERMINED * _field_radius(problem)
    if _is_flat(problem.points[np.unique(problem.observations.point)]) and rolls_alike(problem.world_from_cam):
        moved = np.isin(problem.refine * len(problem.intrinsics), ("cx", "cy"))
        if moved.any():
            limit = NOT_DETERMINED_FLAT * _noise_px(problem) / np.sqrt(len(problem.observations))
            if (effect[moved] > limit).any():
                bad |= effect > limit
    if not bad.any():
        return ()
    found = [
        f"{name} (sigma {value:.3g} px at the edge of the field)"
        for name, value in zip(named(parameter_names, bad), effect[bad].tolist(), strict=True)
    ]
    return (f"interior parameters that this network does not determine: {listed(found)}{_advice(problem)}",)


def quality_warnings(
    problem: BundleProblem, adjustment: Adjustment, dropped: tuple[int, ...], weakness: Floats, lost: Bools
) -> tuple[str, ...]:
    """Return what the reader of an adjustment must know besides its numbers.

    Args:
        dropped: points without an estimate after the outlier test.  weakness: (m,) of ``depth_weakness``.
        lost: (m,) of ``undetermined_points``.
    """
    warnings = []
    names = problem.point_names
    if dropped:
        gone = [names[j] for j in dropped]
        warnings.append(
            f"{len(gone)} point(s) lost their rays to the outlier test and have no estimate: {listed(gone)}"
        )
    rays = adjustment.rays
    few = (rays > 0) & (rays < 3) & ~problem.known()
    if few.any():
        warnings.append(
            f"{int(few.sum())} point(s) are uncontrolled, fewer than 3 rays (errors along the epipolar line "
            f"cannot be found): {listed(named(names, few))}"
        )
    unseen = (rays == 0) & ~problem.known()
    unseen[list(dropped)] = False
    if unseen.any():
        warnings.append(
            f"{int(unseen.sum())} point(s) are in no image and have no estimate: {listed(named(names, unseen))}"
        )
    if lost.any():
        text = f"{int(lost.sum())} point(s) have (nearly) parallel rays; their distance is noise and has no sigma"
        warnings.append(f"{text}: {listed(named(names, lost))}")
    weak = (weakness > WEAK_DEPTH) & ~lost
    if weak.any():
        text = f"{int(weak.sum())} point(s) are seen under so small an angle that their distance is known to 1 % only"
        warnings.append(f"{text}: {listed(named(names, weak))}")
    low = adjustment.redundancy_numbers.min(axis=1) < HARDLY_CHECKED
    if low.mean() > SHARE_HARDLY_CHECKED:
        share = f"{int(low.sum())} of {len(low)} image points have a redundancy number below {HARDLY_CHECKED}"
        warnings.append(f"{share}: a gross error in them would hardly show")
    flags = tie_flags(problem.visible(), problem.image_names) if not problem.known().any() else ()
    warnings.extend(flags[:MOST_GROUPS])
    if len(flags) > MOST_GROUPS:
        warnings.append(f"{len(flags) - MOST_GROUPS} more groups of images hang on the rest by few points")
    warnings.extend(_variance_warning(adjustment))
    warnings.extend(_weak_parameters(problem, adjustment))
    warnings.extend(_correlations(problem, adjustment))
    return tuple(warnings)


def _variance_warning(adjustment: Adjustment) -> tuple[str, ...]:
    if adjustment.redundancy <= 0:
        return ("redundancy is 0: nothing checks the image points, sigma0 is undefined",)
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], adjustment.redundancy) / adjustment.redundancy)
    if low <= adjustment.sigma0 <= high:
        return ()
    return (
        f"sigma0 {adjustment.sigma0:.3f} lies outside [{low:.3f}, {high:.3f}] (99.9 %): the a-priori sigma of the "
        "image points is not theirs, or something is not modelled (gross errors: --robust; the lens: --refine)",
    )


def _weak_parameters(problem: BundleProblem, adjustment: Adjustment) -> tuple[str, ...]:
    if not adjustment.parameter_names:
        return ()
    sigma = np.sqrt(np.maximum(np.diag(adjustment.parameter_covariance), 0.0))
    weak = parameter_effect(problem, sigma) > WEAK_PARAMETER * _noise_px(problem)
    if not weak.any():
        return ()
    text = f"interior parameters that this network determines weakly: {listed(named(adjustment.parameter_names, weak))}"
    return (text + _advice(problem),)


def _correlations(problem: BundleProblem, adjustment: Adjustment) -> tuple[str, ...]:
    sigma = np.sqrt(np.diag(adjustment.parameter_covariance))
    correlation = adjustment.parameter_covariance / np.outer(sigma, sigma)
    first, second = np.nonzero(np.triu(np.abs(correlation) > CORRELATION, 1))
    names = adjustment.parameter_names
    pairs = [
        f"{names[a]}-{names[b]} {correlation[a, b]:+.3f}" for a, b in zip(first.tolist(), second.tolist(), strict=True)
    ]
    if not pairs:
        return ()
    advice = ""
    if rolls_alike(problem.world_from_cam) and any("c" in pair for pair in pairs):
        advice = "; images rolled by 90° would separate them"
    return (f"interior parameters correlated above {CORRELATION}: {listed(pairs)}{advice}",)
