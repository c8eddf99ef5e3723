"""Sets as real projects bring them: every published sigma against a dense bordered solution of everything."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from netdesign.adjust import adjust_folder
from netdesign.errors import InfeasibleError, InputError
from netdesign.files.datum_tables import read_control
from netdesign.model.frames import exp_rotation
from netdesign.photogrammetry.datum import s_transformation
from tests.projects import (
    MODELS,
    aerial,
    building,
    dense_sigmas,
    disagreement,
    field_of_targets,
    observed,
    part,
    poor_start,
    write_project,
)

ALL = ("f", "cx", "cy", "k1", "k2", "p1", "p2")


def _adjusted(folder, truth, start=None, **options):
    write_project(folder, truth if start is None else start)
    return adjust_folder(folder, **options).record


def _points(project, record):
    by_id = {row["id"]: row for row in record["points"]}
    return np.array([by_id[str(i)]["xyz_mm"] for i in project.ids]) / 1e3


@pytest.mark.parametrize("datum", ["free", "control", "fixed"])
def test_national_coordinates_cost_nothing(tmp_path, datum):
    near = _adjusted(tmp_path / "near", aerial(offset=(0, 0, 0)), sigma_px=0.3, datum=datum)
    project = aerial()
    far = _adjusted(tmp_path / "far", project, sigma_px=0.3, datum=datum)
    assert max(disagreement(project, far, datum)) < 1e-9
    for kind, key in (("points", "sigma_mm"), ("images", "sigma_position_mm"), ("images", "sigma_rotation_rad")):
        a, b = (np.array([row[key] for row in record[kind]]) for record in (near, far))
        np.testing.assert_allclose(b, a, rtol=1e-6)
    assert far["redundancy"] == near["redundancy"]
    assert far["sigma0"] == pytest.approx(near["sigma0"], rel=1e-7)


def test_metres_and_degrees_off_end_at_the_same_minimum(tmp_path):
    project = aerial(25, 300, control=7)
    good = _adjusted(tmp_path / "good", project, sigma_px=0.3, datum="control")
    poor = _adjusted(
        tmp_path / "poor", project, poor_start(project, position=40, degrees=5, point=40), sigma_px=0.3, datum="control"
    )
    assert max(disagreement(project, poor, "control")) < 1e-9
    assert np.abs(_points(project, poor) - _points(project, good)).max() < 1e-6
    error = _points(project, good) - project.points
    sigma = np.array([{row["id"]: row for row in good["points"]}[str(i)]["sigma_mm"] for i in project.ids]) / 1e3
    assert 0.5 < np.sqrt(((error / sigma) ** 2).mean()) < 1.5


@pytest.mark.parametrize("wrong", ["control at zero", "another frame", "both"])
def test_control_points_whose_approximations_are_wrong(tmp_path, wrong):
    project = aerial(6, 80, control=5)
    good = _adjusted(tmp_path / "good", project, sigma_px=0.3, datum="control")
    start = poor_start(project, position=2, degrees=1, point=2)
    if wrong != "control at zero":
        turn = exp_rotation(np.array([0.4, -1.2, 0.7]))
        poses = start.poses.copy()
        poses[:, :3, 3] = 0.01 * (poses[:, :3, 3] - project.points.mean(0)) @ turn.T
        poses[:, :3, :3] = turn @ poses[:, :3, :3]
        start = replace(start, poses=poses, points=0.01 * (start.points - project.points.mean(0)) @ turn.T)
    if wrong != "another frame":
        points = start.points.copy()
        # In front of every camera, and nowhere near the truth.
        points[project.control[0]] = start.poses[:, :3, 3].mean(0) + 900 * start.poses[0, :3, 2] * (
            1.0 if wrong == "control at zero" else 0.01
        )
        start = replace(start, points=points)
    found = _adjusted(tmp_path / "start", project, start, sigma_px=0.3, datum="control")
    assert np.abs(_points(project, found) - _points(project, good)).max() < 1e-6


def test_control_with_a_sigma_per_axis_and_points_known_in_plan_or_height_only(tmp_path):
    """Against the dense reference; the same sigma on every axis is the single sigma; what is measured is counted."""
    project = aerial(6, 80, control=6)
    point, xyz, sigma = project.control
    alike = _adjusted(tmp_path / "one", project, sigma_px=0.3, datum="control")
    each = replace(project, control=(point, xyz, np.repeat(sigma[:, None], 3, axis=1)))
    assert _adjusted(tmp_path / "each", each, sigma_px=0.3, datum="control") == alike
    levels = sigma[:, None] * np.array([1.0, 0.5, 3.0])
    levels[0] = 0.0
    levels[1, :2] = np.inf
    levels[2, 2] = levels[3, 2] = np.inf
    mixed = replace(project, control=(point, xyz, levels))
    record = _adjusted(tmp_path / "mixed", mixed, sigma_px=0.3, datum="control")
    assert record["datum"] == f"control: 1 error-free and {len(point) - 1} weighted control points"
    assert record["n_observations"] == 2 * len(project.image) + 3 * (len(point) - 1) - 4
    assert max(disagreement(mixed, record, "control")) < 1e-9
    with pytest.raises(InputError, match="datum fixed: expected control points known along all axes"):
        _adjusted(tmp_path / "fixed", mixed, sigma_px=0.3, datum="fixed")
    plan = levels.copy()
    plan[:, 2], plan[1], plan[0] = np.inf, np.inf, 0.1
    plan[1, 0] = 0.1
    plan[0, 2] = np.inf
    with pytest.raises(InfeasibleError, match=r"control point\(s\) leave [0-9] of 7"):
        _adjusted(tmp_path / "plan", replace(project, control=(point, xyz, plan)), sigma_px=0.3, datum="control")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("3,1,2,3,0,1,1", "sigma 0 .error-free. on all axes or on none"), ("3,1,2,3,,,", "a sigma for at least one"),
        ("3,1,2,3,1,-1,1", "sy_mm: expected 0"), ("3,1,,3,1,1,1", "y_mm: expected a finite"),
        ("3,1,2,3,1,x,1", "sy_mm: expected a finite"),
    ],
)  # fmt: skip
def test_wrong_sigmas_of_control_points(tmp_path, line, says):
    (tmp_path / "control.csv").write_text(f"point,x_mm,y_mm,z_mm,sx_mm,sy_mm,sz_mm\n{line}\n")
    with pytest.raises(InputError, match=says):
        read_control(tmp_path / "control.csv", ["3"])


def test_two_kinds_of_control_and_two_rays(tmp_path):
    """Error-free and weighted control together, one of them measured in two images only; exactly three, fixed."""
    project = aerial(6, 80, control=5)
    point, xyz, sigma = project.control
    sigma = sigma * np.array([1, 0, 1, 0, 2.5])[: len(sigma)]
    rows = np.flatnonzero(project.point == point[0])
    keep = np.ones(len(project.image), bool)
    keep[rows[2:]] = False
    project = replace(
        project,
        control=(point, xyz, sigma),
        image=project.image[keep],
        point=project.point[keep],
        xy=project.xy[keep],
        covariance=project.covariance[keep],
    )
    record = _adjusted(tmp_path / "mixed", project, sigma_px=0.3)
    assert record["datum"] == "control: 2 error-free and 3 weighted control points"
    assert record["n_observations"] == 2 * len(project.image) + 9
    assert record["n_unknowns"] == 6 * 6 + 3 * (len(project.points) - 2)
    assert record["n_datum"] == 0
    assert max(disagreement(project, record, "control")) < 1e-9
    three = replace(project, control=(point[:3], xyz[:3], sigma[:3]))
    record = _adjusted(tmp_path / "three", three, sigma_px=0.3, datum="fixed")
    assert record["n_observations"] == 2 * len(project.image)
    assert max(disagreement(three, record, "fixed")) < 1e-9


@pytest.mark.parametrize("size", [0.2, 2000.0])
@pytest.mark.parametrize("datum", ["free", "scale"])
@pytest.mark.parametrize("refine", [(), ALL, ("fx", "fy", "cx", "cy", "k1")])
def test_free_network_with_scale_bars(tmp_path, size, datum, refine):
    project = part(size=size)
    if size > 1:
        a, b, length, _ = project.bars
        project = replace(project, bars=(a, b, length, np.array([0.05, 0.1])))
    record = _adjusted(tmp_path, project, sigma_px=0.1, datum=datum, refine=refine)
    assert max(disagreement(project, record, datum, refine)) < 1e-8
    assert record["n_datum"] == {"free": 7, "scale": 6}[datum]
    assert record["n_observations"] == 2 * len(project.image) + (2 if datum == "scale" else 0)
    assert record["redundancy"] == record["n_observations"] - record["n_unknowns"] + record["n_datum"]


def test_chosen_datum_points_and_the_scale_of_the_model(tmp_path):
    """A model in arbitrary units and bars in millimetres: the bars give the scale, four points the frame."""
    project = part()
    chosen = [str(project.ids[j]) for j in (0, 5, 9, 20)]
    record = _adjusted(tmp_path / "a", project, sigma_px=0.1, datum="scale", datum_points=chosen)
    assert max(disagreement(project, record, "scale", (), chosen)) < 1e-9
    poses = project.poses.copy()
    poses[:, :3, 3] *= 37.0
    arbitrary = replace(project, poses=poses, points=37.0 * project.points)
    other = _adjusted(tmp_path / "b", project, arbitrary, sigma_px=0.1, datum="scale", datum_points=chosen)
    for a, b in zip(record["points"], other["points"], strict=True):
        np.testing.assert_allclose(b["sigma_mm"], a["sigma_mm"], rtol=1e-6)


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("datum", ["free", "fixed"])
def test_camera_calibration_field_from_catalogue_values(tmp_path, flat, datum):
    """Twenty images with rolls; the focal length 3 % off, no distortion, poses 3 degrees and 5 cm off."""
    project = field_of_targets(flat=flat)
    start = poor_start(project, position=0.05, degrees=3, point=0.02, focal=1.03)
    start.intrinsics[:, 2:] = [1599.5, 1199.5, 0, 0, 0, 0]
    record = _adjusted(tmp_path, project, start, sigma_px=0.15, datum=datum, refine=ALL)
    assert max(disagreement(project, record, datum, ALL)) < 1e-8
    values, sigma = record["intrinsics"]["values"], record["intrinsics"]["sigma"]
    for name, truth in zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"), project.intrinsics[0], strict=True):
        assert abs(values[name] - truth) < 4 * sigma["f" if name in ("fx", "fy") else name]


@pytest.mark.parametrize("model", sorted(MODELS))
def test_every_camera_model_with_every_kind_of_refinement(tmp_path, model):
    project = part(10, 40)
    intrinsics = project.intrinsics.copy()
    fixed = [k for k in range(8) if k not in MODELS[model]]
    intrinsics[:, fixed] = 0.0
    if 1 in fixed:
        intrinsics[:, 1] = intrinsics[:, 0]
    visible = np.zeros((10, 40), bool)
    visible[project.image, project.point] = True
    project = observed(project.poses, project.points, intrinsics, visible, 0.1, models=[model], camera_ids=[3])
    for index, refine in enumerate(((), ("f",), ("fx", "fy"), ("cx", "cy"), ("k1",), ("f", "k1", "k2"), ALL)):
        record = _adjusted(tmp_path / str(index), project, sigma_px=0.1, datum="free", refine=refine)
        assert max(disagreement(project, record, "free", refine)) < 1e-8


def test_weights_of_single_image_points(tmp_path):
    project = building(24, 300, mean_rays=6)
    rng = np.random.default_rng(0)
    root = rng.normal(0, 0.3, (len(project.image), 2, 2)) + 0.3 * np.eye(2)
    covariance = root @ np.swapaxes(root, 1, 2) + 0.02 * np.eye(2)
    project = replace(project, covariance=covariance)
    write_project(tmp_path, project, points2d=False, csv=True, line_end="\r\n")
    record = adjust_folder(tmp_path, datum="free").record
    assert max(disagreement(project, record, "free")) < 1e-7
    # --sigma-px takes the place of what the set says.
    same = adjust_folder(tmp_path, datum="free", sigma_px=0.5, out=tmp_path / "b").record
    uniform = replace(project, covariance=np.tile(0.25 * np.eye(2), (len(covariance), 1, 1)))
    assert max(disagreement(uniform, same, "free")) < 1e-7


@pytest.mark.parametrize("factor", [0.2, 3.0])
def test_noise_far_from_the_assumption_is_healthy(tmp_path, factor):
    """Many two-ray points and sigma0 far from 1: no refusal, and the same a-posteriori sigmas whatever was assumed."""
    project = building(40, 900, sigma=0.6)
    assert (np.bincount(project.point) == 2).mean() > 0.4
    right = _adjusted(tmp_path / "a", project, sigma_px=0.6, datum="free")
    wrong = _adjusted(tmp_path / "b", project, sigma_px=0.6 / factor, datum="free")
    assert wrong["sigma0"] == pytest.approx(factor * right["sigma0"], rel=1e-6)
    for a, b in zip(right["points"], wrong["points"], strict=True):
        np.testing.assert_allclose(b["sigma_mm"], a["sigma_mm"], rtol=1e-6)


def test_one_hopeless_point_does_not_cost_the_others(tmp_path):
    """Two rays that are all but parallel: that point has no sigma and is named, the rest is as it was."""
    project = building(24, 300, mean_rays=6)
    poses = np.concatenate([project.poses, project.poses[:1]])
    poses[-1, :3, 3] += 1e-4
    far = project.poses[0, :3, 3] + 400 * project.poses[0, :3, 2]
    points = np.vstack([project.points, far])
    visible = np.zeros((25, len(points)), bool)
    visible[project.image, project.point] = True
    visible[24] = visible[0]
    visible[[0, 24], -1] = True
    project = observed(poses, points, project.intrinsics, visible, 0.6)
    record = _adjusted(tmp_path, project, sigma_px=0.6, datum="free")
    by_id = {row["id"]: row for row in record["points"]}
    assert by_id[str(project.ids[-1])]["sigma_mm"] == [None] * 3
    assert any("parallel rays" in text and str(project.ids[-1]) in text for text in record["warnings"])
    assert sum(row["sigma_mm"][0] is None for row in record["points"]) == 1


def test_a_panorama_is_refused(tmp_path):
    project = part(4, 40)
    poses = np.tile(project.poses[0], (4, 1, 1))
    for i in range(4):
        poses[i, :3, :3] = poses[i, :3, :3] @ exp_rotation(np.array([0, 0, 0.4 * i]))
    panorama = observed(poses, project.points, project.intrinsics, np.ones((4, 40), bool), 0.1)
    for seed in range(3):
        start = poor_start(panorama, seed, position=2e-3, degrees=0.1, point=1e-3)
        with pytest.raises(InfeasibleError, match=r"not determined|does not converge|parallel rays"):
            _adjusted(tmp_path / str(seed), panorama, start, sigma_px=0.1, datum="free")


@pytest.mark.parametrize("refine", [(), ("f", "cx", "cy")])
def test_two_cameras_have_an_interior_orientation_each(tmp_path, refine):
    project = part(14, 60)
    intrinsics = np.vstack([project.intrinsics[0], project.intrinsics[0] * [1.3, 1.3, 1.02, 0.98, 0.5, 0, 0, 0]])
    visible = np.zeros((14, 60), bool)
    visible[project.image, project.point] = True
    project = observed(
        project.poses,
        project.points,
        intrinsics,
        visible,
        0.1,
        camera_of_image=np.arange(14) % 2,
        models=["OPENCV", "RADIAL"],
        camera_ids=[9, 4],
    )
    project.intrinsics[1, 6:] = 0
    swapped = replace(project, intrinsics=project.intrinsics[::-1], camera_of_image=1 - project.camera_of_image)
    record = _adjusted(tmp_path, project, sigma_px=0.1, datum="free", refine=refine)
    # The record lists the cameras by ascending id: 4 before 9.
    assert max(disagreement(swapped, record, "free", refine)) < 1e-8


def _poses_csv(path, project, position_mm, rotation_deg, which, seed=0, shift=0.0):
    """Priors on the truth with errors of their sigma; an empty sigma where None is given."""
    rng = np.random.default_rng(seed)
    lines = ["image,sigma_position_mm,sigma_rotation_deg,x_mm,y_mm,z_mm,qx,qy,qz,qw"]
    for i in which:
        position = project.poses[i, :3, 3] * 1e3 + (position_mm or 0) * rng.standard_normal(3) + shift
        turn = np.radians(rotation_deg or 0) * rng.standard_normal(3)
        quaternion = Rotation.from_matrix(project.poses[i, :3, :3] @ exp_rotation(turn)).as_quat()
        if rotation_deg is None:
            quaternion = [""] * 4
        values = [project.names[i], position_mm or "", rotation_deg or "", *position, *quaternion]
        lines.append(",".join(str(value) for value in values))
    path.write_text("# from the robot\n" + "\n".join(lines) + "\n")


def test_pose_priors_of_a_robot_carry_the_datum(tmp_path):
    project = replace(part(10, 50), bars=None)
    write_project(tmp_path, poor_start(project, position=0.004, degrees=0.2, point=0.002))
    _poses_csv(tmp_path / "poses.csv", project, 0.05, 0.01, range(10))
    record = adjust_folder(tmp_path, sigma_px=0.1).record
    assert record["datum"] == "poses: 10 pose priors"
    assert (record["n_datum"], record["n_observations"]) == (0, 2 * len(project.image) + 60)
    error = _points(project, record) - project.points
    sigma = np.array([{row["id"]: row for row in record["points"]}[str(i)]["sigma_mm"] for i in project.ids]) / 1e3
    assert np.abs(error / sigma).max() < 5
    # The dense normal equations with the priors as rows.
    _, _, _, covariance = dense_sigmas(project, record, "control", priors=(0.05e-3, np.radians(0.01)))
    first = 6 * 10
    points = np.array([{row["id"]: row for row in record["points"]}[str(i)]["xyz_mm"] for i in project.ids])
    unit = np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())
    dense = np.sqrt(np.diag(covariance))[first:].reshape(-1, 3) * unit
    apriori = np.array([{row["id"]: row for row in record["points"]}[str(i)]["sigma_apriori_mm"] for i in project.ids])
    np.testing.assert_allclose(apriori, dense, rtol=1e-8)
    # The inner precision is that of the free network: the priors say next to nothing about the shape.
    free = adjust_folder(tmp_path, sigma_px=0.1, datum="free", out=tmp_path / "free").record
    inner = np.array([row["sigma_inner_mm"] for row in record["points"]]) / record["sigma0"]
    alone = np.array([row["sigma_apriori_mm"] for row in free["points"]])
    assert (inner < 0.5 * apriori.mean()).all()
    assert 0.9 < np.sqrt((inner**2).mean() / (alone**2).mean()) < 1.2
    assert any("pose priors are not used by datum free" in text for text in free["warnings"])


def test_positions_of_a_satellite_receiver_and_what_is_refused(tmp_path):
    """Positions without rotations are enough, in another frame than the model; one position is not."""
    project = replace(aerial(8, 120), control=None)
    turn = exp_rotation(np.array([0.1, 0.2, 1.0]))
    poses = project.poses.copy()
    poses[:, :3, 3] = 0.01 * (poses[:, :3, 3] - project.points.mean(0)) @ turn.T
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    write_project(
        tmp_path, replace(project, poses=poses, points=0.01 * (project.points - project.points.mean(0)) @ turn.T)
    )
    _poses_csv(tmp_path / "poses.csv", project, 50, None, range(8))
    record = adjust_folder(tmp_path, sigma_px=0.3).record
    assert record["n_observations"] == 2 * len(project.image) + 24
    error = _points(project, record) - project.points
    sigma = np.array([{row["id"]: row for row in record["points"]}[str(i)]["sigma_mm"] for i in project.ids]) / 1e3
    assert np.abs(error / sigma).max() < 5
    _poses_csv(tmp_path / "one.csv", project, 50, None, [3])
    with pytest.raises(InfeasibleError, match="pose priors leave 4 of 7 datum parameters open"):
        adjust_folder(tmp_path, sigma_px=0.3, poses=tmp_path / "one.csv")
    text = (tmp_path / "poses.csv").read_text()
    for old, new, words in (
        ("img 000.jpg,50", "img 000.jpg,0", r"poses\.csv:3: sigma_position_mm: expected a positive number or nothing"),
        ("img 000.jpg", "img 001.jpg", r"poses\.csv:4: image img 001\.jpg stands in the list twice"),
        ("img 000.jpg", "other", r"poses\.csv:3: image 'other' is not in the COLMAP model"),
    ):
        (tmp_path / "poses.csv").write_text(text.replace(old, new, 1))
        with pytest.raises(InputError, match=words):
            adjust_folder(tmp_path, sigma_px=0.3)
    with pytest.raises(InputError, match="datum poses: expected pose priors, found none"):
        adjust_folder(tmp_path, sigma_px=0.3, datum="poses", poses=_empty(tmp_path / "empty.csv"))


def _empty(path):
    path.write_text("image,sigma_position_mm,sigma_rotation_deg\n")
    return path


def test_inner_precision_is_the_s_transformation_of_the_joint_covariance(tmp_path):
    project = aerial(6, 60, control=5)
    record = _adjusted(tmp_path, project, sigma_px=0.3, datum="control")
    _, _, _, covariance = dense_sigmas(project, record, "control")
    first = 6 * 6
    points = np.array([{row["id"]: row for row in record["points"]}[str(i)]["xyz_mm"] for i in project.ids])
    unit = np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())
    inner = s_transformation(covariance[first:, first:] * unit**2, points, parameters=6)
    found = np.array([{row["id"]: row for row in record["points"]}[str(i)]["sigma_inner_mm"] for i in project.ids])
    np.testing.assert_allclose(found / record["sigma0"], np.sqrt(np.diag(inner)).reshape(-1, 3), rtol=1e-8)


def test_images_without_points_and_tables_of_a_spreadsheet(tmp_path):
    """Semicolons, comments, a byte order mark; an image and its camera that saw nothing."""
    project = part(10, 40)
    base = _adjusted(tmp_path / "a", project, sigma_px=0.1, datum="scale")
    blind = replace(
        project,
        poses=np.concatenate([project.poses, project.poses[:1]]),
        names=[*project.names, "unused.jpg"],
        camera_of_image=np.r_[project.camera_of_image, 1],
        intrinsics=np.repeat(project.intrinsics, 2, axis=0),
        models=["OPENCV", "OPENCV"],
        camera_ids=[1, 2],
    )
    write_project(tmp_path / "b", blind)
    bars = tmp_path / "b" / "scalebars.csv"
    bars.write_text("\ufeff# lengths of today\n\n" + bars.read_text().replace(",", "; "), encoding="utf-8")
    record = adjust_folder(tmp_path / "b", sigma_px=0.1, refine=("f",)).record
    assert record["datum"].startswith("scale")
    assert len(record["images"]) == 10
    assert "1 image(s) without image points are left out: unused.jpg" in record["warnings"]
    again = adjust_folder(tmp_path / "b", sigma_px=0.1).record
    for a, b in zip(base["points"], again["points"], strict=True):
        np.testing.assert_allclose(b["sigma_mm"], a["sigma_mm"], rtol=1e-9)


def test_bars_in_every_role(tmp_path):
    """Between fixed points, at weighted control, many at once, free of error; and error-free ones that are too many."""
    project = part()
    points = project.points
    which = np.array([0, 1, 5, 9])
    control = (which, points[which], np.array([1e-5, 0, 0, 1e-5]))
    a, b = np.array([1, 0, 9]), np.array([5, 1, 20])
    length = np.linalg.norm(points[a] - points[b], axis=1) + 1e-5
    joined = replace(project, control=control, bars=(a, b, length, np.array([1e-5, 1e-5, 2e-5])))
    record = _adjusted(tmp_path / "joined", joined, sigma_px=0.1, refine=("f", "k1"))
    assert max(disagreement(joined, record, "control", ("f", "k1"))) < 1e-8
    assert record["n_observations"] == 2 * len(project.image) + 6 + 3
    pairs = np.array([(i, j) for i in range(8) for j in range(i)])
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    many = replace(project, bars=(*pairs.T, length, np.full(28, 1e-5)))
    assert max(disagreement(many, _adjusted(tmp_path / "many", many, sigma_px=0.1), "scale")) < 1e-9
    exact = replace(project, bars=(*pairs[:3].T, length[:3], np.zeros(3)))
    assert _adjusted(tmp_path / "exact", exact, sigma_px=0.1)["n_datum"] == 6
    with pytest.raises(InfeasibleError, match=r"10 of the error-free scale bars follow from the others"):
        _adjusted(tmp_path / "too many", replace(project, bars=(*pairs.T, length, np.zeros(28))), sigma_px=0.1)


@pytest.mark.parametrize("sigma", [1e-9, 1e-4, 1e-2])
def test_control_may_be_exact_or_poor(tmp_path, sigma):
    """From a nanometre to a twentieth of the object: the network is as good as it is, its frame as the control."""
    project = part()
    which = np.array([0, 5, 9])
    project = replace(project, bars=None, control=(which, project.points[which], np.full(3, sigma)))
    record = _adjusted(tmp_path, project, sigma_px=0.1, refine=ALL)
    assert max(disagreement(project, record, "control", ALL)) < 1e-5
