"""The verb: observation sets in files, every datum, units, names, and what is refused."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from netdesign.adjust import adjust_folder
from netdesign.errors import InfeasibleError, InputError
from netdesign.files.colmap import ColmapModel, write_model
from netdesign.model.frames import exp_rotation
from tests.bundle_cases import (
    INTRINSICS,
    camera_of,
    disturbed,
    observe,
    random_visibility,
    relief,
)


def _write(folder, poses, points, observations, names=None, ids=None, cameras=None, camera_of_image=None):
    names = [f"image{i:02d}.png" for i in range(len(poses))] if names is None else names
    ids = [100 + j for j in range(len(points))] if ids is None else ids
    cameras = (camera_of(),) if cameras is None else cameras
    order = np.argsort(names)  # the model wants its images in the order of their names
    rank = np.argsort(order)
    point_order = np.argsort(ids)
    point_rank = np.argsort(point_order)
    of_image = np.zeros(len(poses), np.int64) if camera_of_image is None else np.asarray(camera_of_image)
    write_model(
        folder,
        ColmapModel(
            cameras=cameras,
            camera_ids=tuple(range(1, len(cameras) + 1)),
            camera_of_image=of_image[order],
            names=tuple(names[i] for i in order),
            world_from_cam=poses[order],
            point_ids=tuple(ids[j] for j in point_order),
            points=points[point_order],
            image=rank[observations.image],
            point=point_rank[observations.point],
            xy_px=observations.xy_px,
        ),
    )


def _case(seed=0, images=8, count=40):
    poses, points = relief(images, count, seed=seed)
    visible = random_visibility(images, count, 0.7)
    return poses, points, observe(poses, points, visible, seed=seed)


def _control_csv(path, points, which, sigma_mm, unit=1.0, ids=None):
    ids = [100 + j for j in range(len(points))] if ids is None else ids
    lines = ["point,x_mm,y_mm,z_mm,sigma_mm"]
    for j in which:
        lines.append(",".join([str(ids[j]), *(repr(float(x) * 1e3 * unit) for x in points[j]), repr(sigma_mm * unit)]))
    path.write_text("\n".join(lines) + "\n")


def _bars_csv(path, points, pairs, sigma_mm, unit=1.0):
    lines = ["a,b,length_mm,sigma_mm"]
    for a, b in pairs:
        length = float(np.linalg.norm(points[a] - points[b])) * 1e3 * unit
        lines.append(f"{100 + a},{100 + b},{length!r},{sigma_mm * unit!r}")
    path.write_text("\n".join(lines) + "\n")


def test_free_network_writes_the_contract(tmp_path):
    poses, points, observations = _case()
    _write(tmp_path, *disturbed(poses, points), observations)
    outcome = adjust_folder(tmp_path, sigma_px=0.1, datum="free")
    record = json.loads((tmp_path / "adjustment.json").read_text())
    assert record["format"] == "netdesign/adjustment/1"
    assert record["redundancy"] == record["n_observations"] - record["n_unknowns"] + record["n_datum"]
    assert (record["n_unknowns"], record["n_datum"]) == (6 * 8 + 3 * 40, 7)
    assert record["converged"] is True
    assert 0.8 < record["sigma0"] < 1.2
    point = record["points"][3]
    assert point["id"] == "103"
    np.testing.assert_allclose(
        np.array(point["sigma_mm"]), np.array(point["sigma_apriori_mm"]) * record["sigma0"], rtol=1e-12
    )
    np.testing.assert_allclose(np.sqrt(np.diag(point["covariance_mm2"])), point["sigma_mm"], rtol=1e-12)
    assert record["images"][0]["name"] == "image00.png"
    assert "free: inner constraints over all object points" in outcome.text
    again = adjust_folder(tmp_path, sigma_px=0.1, datum="free", out=tmp_path / "b")
    assert again.path.read_bytes() == (tmp_path / "adjustment.json").read_bytes()


@pytest.mark.parametrize("mark", ["run/networks/0003/validation.json", "run/study.toml"])
@pytest.mark.parametrize("named", [False, True])
def test_the_adjustment_of_a_validation_is_not_touched(tmp_path, mark, named):
    poses, points, observations = _case()
    folder = tmp_path / "run" / "networks" / "0003"
    _write(folder, *disturbed(poses, points), observations)
    (tmp_path / mark).write_text("")
    (folder / "adjustment.json").write_text("the validation's")
    outcome = adjust_folder(folder, sigma_px=0.1, out=folder if named else None)
    assert (folder / "adjustment.json").read_text() == "the validation's"
    assert outcome.path == folder / "adjustment-own.json"
    assert outcome.path.is_file()
    assert "adjustment-own.json" in outcome.text
    assert adjust_folder(folder, sigma_px=0.1, out=tmp_path / "b").path == tmp_path / "b" / "adjustment.json"


@pytest.mark.parametrize("datum", ["free", "scale", "control", "fixed"])
def test_units_names_and_order_do_not_matter(tmp_path, datum):
    poses, points, observations = _case(seed=1)
    rng = np.random.default_rng(3)
    results = []
    for index, unit in enumerate([1.0, 1000.0, 1 / 25.4]):
        folder = tmp_path / str(index)
        scaled = poses.copy()
        scaled[:, :3, 3] *= unit
        names, ids, shuffle = None, None, np.arange(len(poses))
        if index:
            names = [f"{name}.jpg" for name in rng.permutation(len(poses))]
            shuffle = rng.permutation(len(poses))
        order = rng.permutation(len(observations)) if index else np.arange(len(observations))
        mixed = observations.select(order)
        place = np.argsort(shuffle)
        mixed = type(mixed)(image=place[mixed.image], point=mixed.point, xy_px=mixed.xy_px, covariance=mixed.covariance)
        _write(folder, scaled[shuffle], unit * points, mixed, names, ids)
        _control_csv(folder / "control.csv", points, [0, 5, 9, 17, 30], 0.02, unit)
        _bars_csv(folder / "scalebars.csv", points, [(0, 7), (3, 12)], 0.01, unit)
        record = adjust_folder(folder, sigma_px=0.1, datum=datum, refine=("f", "k1")).record
        sigma = np.array([p["sigma_mm"] for p in record["points"]]) / unit
        results.append((record["sigma0"], sigma, record["intrinsics"]["sigma"]["f"]))
    for other in results[1:]:
        assert other[0] == pytest.approx(results[0][0], rel=1e-9)
        np.testing.assert_allclose(other[1], results[0][1], rtol=1e-9)
        assert other[2] == pytest.approx(results[0][2], rel=1e-9)


def test_datum_default_follows_what_the_set_holds(tmp_path):
    poses, points, observations = _case()
    _write(tmp_path, poses, points, observations)
    assert adjust_folder(tmp_path).adjustment.datum.startswith("free")
    _bars_csv(tmp_path / "scalebars.csv", points, [(0, 7)], 0.01)
    assert adjust_folder(tmp_path).adjustment.datum.startswith("scale: inner constraints (6)")
    _control_csv(tmp_path / "control.csv", points, [0, 5, 9], 0.0)
    outcome = adjust_folder(tmp_path)
    assert outcome.adjustment.datum == "control: 3 error-free control points, 1 scale bar(s)"
    np.testing.assert_allclose(outcome.adjustment.points[[0, 5, 9]], points[[0, 5, 9]], rtol=0, atol=1e-14)
    assert (outcome.adjustment.point_covariance[[0, 5, 9]] == 0).all()
    assert any("1 px is assumed" in text for text in outcome.adjustment.warnings)


def test_control_in_another_frame_than_the_model(tmp_path):
    poses, points, observations = _case()
    rotation, shift, scale = exp_rotation(np.array([0.5, -1.0, 2.0])), np.array([5.0, -3.0, 2.0]), 3.0
    world = scale * points @ rotation.T + shift
    _write(tmp_path, poses, points, observations)
    _control_csv(tmp_path / "control.csv", world, range(6), 0.0)
    result = adjust_folder(tmp_path, sigma_px=0.1).adjustment
    assert np.abs(result.points - world).max() < 5e-4


def test_several_cameras_each_with_its_own_interior_orientation(tmp_path):
    poses, points = relief(12, 40, seed=5)
    other = INTRINSICS * [1.2, 1.2, 1.01, 0.99, 0.5, 0.5, 1, 1]
    visible = np.ones((6, 40), bool)
    first = observe(poses[:6], points, visible, seed=1)
    second = observe(poses[6:], points, visible, seed=2, intrinsics=other)
    observations = type(first)(
        image=np.r_[first.image, second.image + 6],
        point=np.r_[first.point, second.point],
        xy_px=np.r_[first.xy_px, second.xy_px],
        covariance=np.r_[first.covariance, second.covariance],
    )
    start = camera_of(INTRINSICS + [20, 20, 3, 3, 0, 0, 0, 0]), camera_of(other + [-20, -20, 3, 3, 0, 0, 0, 0])
    _write(tmp_path, poses, points, observations, cameras=start, camera_of_image=[0] * 6 + [1] * 6)
    outcome = adjust_folder(tmp_path, sigma_px=0.1, refine=("fx", "fy", "cx", "cy"))
    result = outcome.adjustment
    sigma = np.sqrt(np.diag(result.parameter_covariance)).reshape(2, 4)
    error = np.abs(result.intrinsics - [INTRINSICS, other])[:, :4]
    assert (error < 4 * sigma).all()
    assert result.parameter_names[4] == "camera 2 fx"
    assert len(outcome.record["intrinsics"]["cameras"]) == 2


def test_observations_csv_replaces_the_points2d(tmp_path):
    poses, points, observations = _case(seed=2)
    _write(tmp_path, poses, points, observations)
    before = adjust_folder(tmp_path, sigma_px=0.1, datum="free").record
    lines = ["image,point,x_px,y_px,sxx_px2,sxy_px2,syy_px2"]
    for i, j, (x, y) in zip(observations.image, observations.point, observations.xy_px, strict=True):
        lines.append(f"image{i:02d}.png,{100 + j},{float(x)!r},{float(y)!r},0.01,0,0.01")
    (tmp_path / "observations.csv").write_text("\n".join(lines) + "\n")
    after = adjust_folder(tmp_path, datum="free").record
    assert after["sigma0"] == pytest.approx(before["sigma0"], rel=1e-6)
    for row, words in (
        (lines[7].replace("image", "picture", 1), "is not in the COLMAP model"),
        (lines[7].replace(",0.01,0,", ",0.01,0.5,"), "positive definite"),
        (lines[6], "observed twice"),
        (",".join(["image00.png", "100", "nan", "1", "0.01", "0", "0.01"]), "x_px: expected a finite number"),
        ("image00.png,9999,1,2,0.01,0,0.01", "point '9999' is not in the COLMAP model"),
        ("image00.png,100", "expected 7 values"),
    ):
        spoilt = [*lines[:7], row, *lines[8:]]
        (tmp_path / "observations.csv").write_text("\n".join(spoilt) + "\n")
        with pytest.raises(InputError, match=r"observations\.csv:8: .*" + words):
            adjust_folder(tmp_path)


def test_gross_errors_are_found_and_listed(tmp_path):
    poses, points, observations = _case(seed=4, images=10, count=60)
    xy = observations.xy_px.copy()
    xy[37] += [8.0, -5.0]
    spoilt = type(observations)(
        image=observations.image, point=observations.point, xy_px=xy, covariance=observations.covariance
    )
    _write(tmp_path, poses, points, spoilt)
    for sigma_px in (0.1, None):  # known or not
        record = adjust_folder(tmp_path, sigma_px=sigma_px, datum="free", robust=True).record
        names = {(row["image"], row["point"]) for row in record["rejected"]}
        assert (f"image{observations.image[37]:02d}.png", str(100 + observations.point[37])) in names
        assert len(names) <= 3
    plain = adjust_folder(tmp_path, sigma_px=0.1, datum="free").record
    assert plain["sigma0"] > 1.3
    assert any("sigma0" in text for text in plain["warnings"])


def test_bad_input_is_one_clear_line(tmp_path):
    poses, points, observations = _case()
    _write(tmp_path / "set", poses, points, observations)
    folder = tmp_path / "set"
    with pytest.raises(InputError, match="expected a folder"):
        adjust_folder(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="expected a COLMAP text model"):
        adjust_folder(tmp_path / "empty")
    with pytest.raises(InputError, match=r"refine: expected a subset of f, .*found focal"):
        adjust_folder(folder, refine=("focal",))
    with pytest.raises(InputError, match="f moves fx and fy together"):
        adjust_folder(folder, refine=("f", "fx"))
    with pytest.raises(InputError, match=r"datum-points: .*'7'"):
        adjust_folder(folder, datum_points=["100", "7"])
    with pytest.raises(InputError, match="expected control points, found none"):
        adjust_folder(folder, datum="control")
    with pytest.raises(InputError, match="expected scale bars, found none"):
        adjust_folder(folder, datum="scale")
    with pytest.raises(InputError, match="sigma_px: expected a positive"):
        adjust_folder(folder, sigma_px=-1.0)
    control = tmp_path / "control.csv"
    for text, words in (
        ("point,x_mm,y_mm,z_mm\n", "found no sigma_mm"),
        ("point,x_mm,y_mm,z_mm,sigma_mm\n999,0,0,0,0\n", "control point '999' is not in the COLMAP model"),
        ("point,x_mm,y_mm,z_mm,sigma_mm\n100,0,0,0,-1\n", "sigma_mm: expected 0"),
        ("point,x_mm,y_mm,z_mm,sigma_mm\n100,0,x,0,0\n", "y_mm: expected a finite number, found 'x'"),
    ):
        control.write_text(text)
        with pytest.raises(InputError, match=words):
            adjust_folder(folder, control=control)
    _control_csv(control, points, [0, 5], 0.0)
    with pytest.raises(InfeasibleError, match=r"2 control point\(s\) leave 1 of 7 datum parameters open"):
        adjust_folder(folder, control=control)
    bars = tmp_path / "bars.csv"
    bars.write_text("a,b,length_mm,sigma_mm\n100,100,5,0.1\n")
    with pytest.raises(InputError, match=r"bars\.csv:2: expected two different points"):
        adjust_folder(folder, scale_bars=bars)


def test_nan_in_the_model_and_empty_lists_of_the_command_line(tmp_path):
    poses, points, observations = _case()
    xy = observations.xy_px.copy()
    xy[5, 1] = np.nan
    spoilt = type(observations)(
        image=observations.image, point=observations.point, xy_px=xy, covariance=observations.covariance
    )
    _write(tmp_path / "nan", poses, points, spoilt)
    with pytest.raises(InputError, match=r"images\.txt:6: expected finite numbers, found nan"):
        adjust_folder(tmp_path / "nan")
    _write(tmp_path / "good", poses, points, observations)
    assert adjust_folder(tmp_path / "good", datum_points=[], refine=[]).adjustment.parameter_names == ()


def test_control_point_that_is_nowhere_seen(tmp_path):
    poses, points, observations = _case()
    visible = np.zeros((8, 40), bool)
    visible[observations.image, observations.point] = True
    visible[:, 5] = False
    _write(tmp_path, poses, points, observe(poses, points, visible))
    _control_csv(tmp_path / "control.csv", points, [0, 5, 9, 12], 0.0)
    with pytest.raises(InfeasibleError, match=r"1 control point\(s\) are observed in no image: 105"):
        adjust_folder(tmp_path, datum="control")
    shutil.copy(tmp_path / "control.csv", tmp_path / "other.csv")
    assert adjust_folder(tmp_path, datum="free").record["points"][5]["sigma_mm"] == [None] * 3


def test_a_lens_that_folds_the_image_below_its_image_points_is_named(tmp_path):
    poses, points, observations = _case()
    camera = replace(camera_of(), distortion=np.array([-12.0, 0.0, 0.0, 0.0]))
    _write(tmp_path, poses, points, observations, cameras=(camera,))
    with pytest.raises(InfeasibleError, match=r"image point\(s\) lie up to .* carries no ray beyond"):
        adjust_folder(tmp_path, sigma_px=0.1)
    _write(tmp_path, poses, points, observations)
    assert not any("no ray" in warning for warning in adjust_folder(tmp_path, sigma_px=0.1).record["warnings"])
