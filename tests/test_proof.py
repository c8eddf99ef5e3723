"""What a proved network says against itself: points by their names, in words that fit what happened."""

from dataclasses import replace

import numpy as np
import pytest

from netdesign.adjustment.diagnosis import SHARE_HARDLY_CHECKED, quality_warnings
from netdesign.adjustment.estimate import estimate
from netdesign.files.design_json import read_networks
from netdesign.imaging.measure import TagMeasurement
from netdesign.model.camera import CornerNoise
from netdesign.model.network import Observations
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.photogrammetry.collinearity import project
from netdesign.placement.distances import network_total_error
from netdesign.proof import _adjusted, _as_planned, _intersected
from netdesign.validate import noise_hint
from tests.bundle_cases import observe, problem_of, relief
from tests.runs import convex_visible, ring_run


@pytest.fixture(scope="module")
def proved(tmp_path_factory):
    run = tmp_path_factory.mktemp("proof") / "run"
    task = ring_run(run)
    return task, max(read_networks(run).values(), key=lambda network: len(network.world_from_cam))


def test_a_point_that_loses_its_rays_to_the_outlier_test_is_not_called_unseen(proved):
    task, network = proved
    poses, points = network.world_from_cam, task.scene.targets.points
    visible = convex_visible(task, poses)
    visible[np.flatnonzero(visible[:, 0])[3:], 0] = False  # three rays, one of them wrong
    image, point = np.nonzero(visible)
    sigma = task.camera.sigma_px
    xy = project(poses[image], points[point], task.camera.intrinsics)[0]
    xy = xy + np.random.default_rng(0).normal(scale=sigma, size=xy.shape)
    xy[np.flatnonzero(point == 0)[1]] += 40.0
    covariance = np.tile(sigma**2 * np.eye(2), (len(image), 1, 1))
    observations = Observations(image=image, point=point, xy_px=xy, covariance=covariance)
    _, adjustment = _adjusted(task, network, observations, [f"{index}.png" for index in range(len(poses))])
    warnings = adjustment.warnings
    name = task.scene.targets.point_ids[0]
    assert any("lost their rays to the outlier test" in text and text.endswith(name) for text in warnings)
    assert not any("in no image" in text for text in warnings)


def test_what_total_propagation_flags_is_named_as_the_design_names_it(proved):
    task, network = proved
    diagnosis = network_total_error(task, network.world_from_cam[:3]).diagnosis
    assert diagnosis
    assert any(name in text for text in diagnosis for name in task.scene.targets.point_ids), diagnosis


@pytest.mark.parametrize(("share", "told"), [(0.5 * SHARE_HARDLY_CHECKED, False), (2 * SHARE_HARDLY_CHECKED, True)])
def test_a_few_hardly_checked_image_points_are_no_flag(share, told):
    poses, points = relief(6, 40)
    problem = problem_of(observe(poses, points, np.ones((6, 40), bool)), poses, points)
    adjustment = estimate(problem)
    numbers = np.full_like(adjustment.redundancy_numbers, 0.6)
    numbers[: round(share * len(numbers))] = 0.05
    nothing = np.zeros(len(points))
    warnings = quality_warnings(
        problem, replace(adjustment, redundancy_numbers=numbers), (), nothing, nothing.astype(bool)
    )
    assert any("a gross error in them would hardly show" in text for text in warnings) == told


def _tag(tag_id):
    return TagMeasurement(
        tag_id=tag_id, corners_px=np.zeros((4, 2)), covariance_px2=np.eye(8), rejected="", chi2_per_dof=1.0, pixels=900,
        sigma_px=0.7, black=20.0, white=235.0, cell_px=5.0, incidence=0.1, seed_shift_px=0.3,
    )  # fmt: skip


def test_what_the_plan_does_not_count_on_is_not_used(proved):
    task, network = proved
    visible = convex_visible(task, network.world_from_cam)[:, ::CORNERS_PER_TAG]
    ids = task.scene.targets.ids.tolist()
    measured = [[_tag(tag) for tag in ids] for _ in network.world_from_cam]
    used = [[not tag.rejected for tag in tags] for tags in _as_planned(task, network, measured)]
    assert 0 < np.sum(used) < visible.size
    np.testing.assert_array_equal(used, visible)


def test_a_tag_of_one_image_is_left_out_by_name(proved):
    task, network = proved
    ids, poses = task.scene.targets.ids, network.world_from_cam
    image, tag = np.array([0, 1, 0, 2]), np.array([0, 0, 1, 2])  # of tag 0 two images, of the others at most one
    point = (CORNERS_PER_TAG * tag[:, None] + np.arange(CORNERS_PER_TAG)).ravel()
    observations = Observations(
        image=np.repeat(image, CORNERS_PER_TAG), point=point, xy_px=np.zeros((16, 2)),
        covariance=np.tile(np.eye(2), (16, 1, 1)),
    )  # fmt: skip
    each = [k * np.eye(8) for k in range(4)]
    left, covariances, alone = _intersected(observations, each, task.scene.targets, poses)
    assert left.point.tolist() == [0, 1, 2, 3] * 2
    assert [matrix[0, 0] for matrix in covariances] == [0, 1]
    assert alone[0] == f"tag {ids[1]}: measured in 1 image(s), at least 2 needed"
    assert len(alone) == len(ids) - 1
    twice = np.concatenate([poses[:1], poses[:1], poses[2:]])  # the plan takes the picture of one station twice
    left, covariances, alone = _intersected(observations, each, task.scene.targets, twice)
    assert len(left) == len(covariances) == 0
    assert alone[-1] == f"tag {ids[0]}: measured in 2 images of one station, at least 2 stations needed"


@pytest.mark.parametrize(("total", "says"), [(20.0, "0.01 px"), (1.0, "0.2 px"), (2.4, None), (None, None)])
def test_image_points_far_from_the_assumed_sigma_are_said(tmp_path, total, says):
    task = ring_run(tmp_path / "run", sizes=(8,))
    lines = noise_hint(task, [{"predicted_rms_um": {"limited": 1.0, "total": total, "used": 2.0}}])
    assert len(lines) == (says is not None)
    assert all(f"have about {says} where the design assumes camera.sigma_px = 0.1" in line for line in lines)
    detector = replace(task, camera=replace(task.camera, corner_noise=CornerNoise(k=1.0, floor_px=0.0)))
    assert noise_hint(detector, [{"predicted_rms_um": {"limited": 1.0, "total": 20.0, "used": 2.0}}]) == []
