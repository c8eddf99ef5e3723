"""COLMAP and Ceres on the same networks, and dense bordered normal equations for every datum.

COLMAP's estimate_ba_covariance gives point covariances conditioned on the poses: the limited ones. Ceres' joint
covariance of all points in COLMAP's gauge (one camera and one coordinate of a second held: seven constraints),
carried to the free datum, is the total one.
"""

import numpy as np
import pycolmap
import pytest

from netdesign.adjustment.bundle import adjust, joint_marginals
from netdesign.adjustment.estimate import estimate
from netdesign.model.adjustment import ControlPoints, PosePriors, ScaleBars
from netdesign.model.frames import inverse, similarity
from netdesign.photogrammetry.datum import point_null_space, s_transformation
from netdesign.photogrammetry.total_error import total_covariance
from tests.bundle_cases import (
    INTRINSICS,
    bordered_covariance,
    camera_of,
    dense_design,
    disturbed,
    observe,
    problem_of,
    random_visibility,
    relative,
    relief,
)

SIGMA = 0.1


def _colmap(poses, points, observations, intrinsics=INTRINSICS):
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="OPENCV", width=2448, height=2048, params=intrinsics)
    )
    for j, xyz in enumerate(points):
        reconstruction.add_point3D_with_id(j + 1, pycolmap.Point3D(xyz=xyz))
    config = pycolmap.BundleAdjustmentConfig()
    for i, cam_from_world in enumerate(inverse(poses)):
        rows = np.flatnonzero(observations.image == i)
        image = pycolmap.Image(name=str(i), keypoints=observations.xy_px[rows], camera_id=1, image_id=i + 1)
        reconstruction.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(cam_from_world[:3, :3]), cam_from_world[:3, 3])
        )
        for position, row in enumerate(rows):
            element = pycolmap.TrackElement(image_id=i + 1, point2D_idx=position)
            reconstruction.add_observation(int(observations.point[row]) + 1, element)
        config.add_image(i + 1)
    config.set_constant_cam_intrinsics(1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    solver = options.ceres.solver_options
    solver.gradient_tolerance = solver.function_tolerance = solver.parameter_tolerance = 1e-14
    solver.max_num_iterations = 200
    return reconstruction, pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)


@pytest.mark.parametrize(("images", "count"), [(4, 28), (10, 60)])
def test_colmap_and_ceres_agree(images, count):
    pyceres = pytest.importorskip("pyceres")
    poses, points = relief(images, count, seed=images)
    visible = random_visibility(images, count, 0.7)
    observations = observe(poses, points, visible, SIGMA)
    reconstruction, adjuster = _colmap(*disturbed(poses, points, point=0.0005, rotation=0.0005), observations)
    adjuster.solve()
    xyz = np.array([reconstruction.points3D[j + 1].xyz for j in range(count)])
    found = np.array([reconstruction.images[i + 1].cam_from_world().matrix() for i in range(images)])
    found_poses = inverse(np.concatenate([found, np.tile([[[0, 0, 0, 1.0]]], (images, 1, 1))], axis=1))

    own = estimate(problem_of(observations, poses, points), joint=True)
    scale, rotation, translation = similarity(xyz, own.points)
    assert np.abs(scale * xyz @ rotation.T + translation - own.points).max() < 1e-10  # m: 1e-4 um

    total = total_covariance(found_poses, xyz, INTRINSICS, visible, SIGMA)
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), reconstruction, adjuster)
    limited = np.array([covariance.get_point_cov(j + 1) for j in range(count)]) * SIGMA**2
    assert relative(limited, total.limited) < 1e-12

    ceres = pyceres.Covariance(pyceres.CovarianceOptions())
    blocks = [reconstruction.points3D[j + 1].xyz for j in range(count)]
    pairs = [(blocks[a], blocks[b]) for a in range(count) for b in range(a, count)]
    assert ceres.compute(pairs, adjuster.problem)
    joint = np.zeros((3 * count, 3 * count))
    for a in range(count):
        for b in range(a, count):
            block = ceres.get_covariance_block(blocks[a], blocks[b])
            joint[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] = block
            joint[3 * b : 3 * b + 3, 3 * a : 3 * a + 3] = block.T
    free = s_transformation(joint * SIGMA**2, xyz)
    assert relative(free, total.joint()) < 1e-9
    by_gtsam = adjust(observations, camera_of(), found_poses, xyz)
    assert relative(by_gtsam.joint_covariance, free) < 1e-9


def _rows_of(adjustment, refine):
    """First column of the points in the dense design."""
    from netdesign.photogrammetry.observation_equations import parameter_matrix

    matrix = parameter_matrix(refine, adjustment.intrinsics[0])
    design, _ = dense_design(
        adjustment.world_from_cam, adjustment.points, adjustment.observations, adjustment.intrinsics[0], matrix
    )
    return design, design.shape[1] - 3 * len(adjustment.points)


def _bar_rows(points, bars, first, width):
    rows = np.zeros((len(bars.a), width))
    for row, a, b, sigma in zip(rows, bars.a, bars.b, bars.sigma, strict=True):
        direction = (points[a] - points[b]) / np.linalg.norm(points[a] - points[b])
        row[first + 3 * a : first + 3 * a + 3] = direction / sigma
        row[first + 3 * b : first + 3 * b + 3] = -direction / sigma
    return rows


@pytest.mark.parametrize("refine", [(), ("f", "cx", "cy", "k1", "k2", "p1", "p2")])
@pytest.mark.parametrize(
    "kind", ["scale", "error-free bar", "weighted control", "fixed control", "control and bar", "priors"]
)
def test_every_datum_equals_the_dense_bordered_solution(kind, refine):
    images, count = 8, 40
    poses, points = relief(images, count, seed=7)
    visible = random_visibility(images, count, 0.8)
    observations = observe(poses, points, visible, SIGMA)
    rng = np.random.default_rng(1)
    some = np.array([0, 6, 11, 20, 33])
    sigma = np.zeros(5)
    if kind == "weighted control":
        sigma = np.array([1e-5, 2e-5, 2e-5, 5e-5, 1e-4])
    if kind == "control and bar":  # error-free and weighted mixed
        sigma = np.array([0.0, 2e-5, 2e-5, 5e-5, 1e-4])
    control = ControlPoints(point=some, xyz=points[some] + sigma[:, None] * rng.standard_normal((5, 3)), sigma=sigma)
    bars = ScaleBars(
        a=[1, 2], b=[9, 30], length=np.linalg.norm(points[[1, 2]] - points[[9, 30]], axis=1), sigma=[5e-6, 8e-6]
    )
    if kind == "error-free bar":
        bars = ScaleBars(a=[1], b=[9], length=bars.length[:1], sigma=[0.0])
    priors = PosePriors(world_from_cam=poses, sigma_position=3e-5, sigma_rotation=3e-5)
    options = {
        "scale": {"datum": "scale", "bars": bars},
        "error-free bar": {"datum": "scale", "bars": bars},
        "weighted control": {"datum": "control", "control": control},
        "fixed control": {"datum": "fixed", "control": control},
        "control and bar": {"datum": "control", "control": control, "bars": bars},
        "priors": {"datum": "poses", "bars": bars, "priors": priors},
    }[kind]
    start = disturbed(poses, points, seed=3)
    result = estimate(problem_of(observations, *start, refine=refine, **options), joint=True)
    design, first = _rows_of(result, refine)
    extra = []
    if "bars" in options and kind != "error-free bar":
        extra.append(_bar_rows(result.points, bars, first, design.shape[1]))
    fixed = np.zeros(0, dtype=int)
    if "control" in options:
        fixed = some[control.exact]
        for j, s in zip(some[~control.exact], control.sigma[~control.exact], strict=True):
            rows = np.zeros((3, design.shape[1]))
            rows[range(3), range(first + 3 * j, first + 3 * j + 3)] = 1 / s
            extra.append(rows)
    if kind == "priors":
        rows = np.zeros((6 * images, design.shape[1]))
        rows[range(6 * images), range(6 * images)] = 1 / 3e-5
        extra.append(rows)
    full = np.vstack([design, *extra])
    borders = np.zeros((design.shape[1], 0))
    if kind in ("scale", "error-free bar"):
        borders = np.zeros((design.shape[1], 6))
        borders[first:] = point_null_space(result.points, parameters=6)
    if kind == "error-free bar":
        unit = ScaleBars(a=bars.a, b=bars.b, length=bars.length, sigma=[1.0])
        borders = np.hstack([borders, _bar_rows(result.points, unit, first, design.shape[1]).T])
    keep = np.ones(design.shape[1], bool)
    for j in fixed:
        keep[first + 3 * j : first + 3 * j + 3] = False
    reference = np.zeros((design.shape[1], design.shape[1]))
    reference[np.ix_(keep, keep)] = bordered_covariance(full[:, keep], borders[keep])
    assert relative(result.joint_covariance, reference[first:, first:]) < 1e-9
    index = np.arange(images)
    poses_reference = reference[: 6 * images, : 6 * images].reshape(images, 6, images, 6)[index, :, index, :]
    assert relative(result.pose_covariance[:, 3:, 3:], poses_reference[:, 3:, 3:]) < 1e-9
    assert relative(result.pose_covariance[:, :3, :3], poses_reference[:, :3, :3]) < 1e-9
    if kind in ("scale", "weighted control") and not refine:
        solved = problem_of(observations, result.world_from_cam, result.points, result.intrinsics, **options)
        normalised, unit, _ = solved.normalised()
        by_gtsam = joint_marginals(normalised, result.used) * unit**2
        assert relative(by_gtsam, reference[first:, first:]) < 1e-9
    if refine:
        assert relative(result.parameter_covariance, reference[6 * images : first, 6 * images : first]) < 1e-9
    assert result.redundancy == full.shape[0] - keep.sum() + borders.shape[1]
    if kind == "error-free bar":
        assert np.linalg.norm(result.points[1] - result.points[9]) == pytest.approx(bars.length[0], rel=1e-12)
