"""Study files: every mistake is one line that says where, what was expected and what was found."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from netdesign.check import check_study
from netdesign.errors import InfeasibleError, InputError
from netdesign.files.study import load_task, resolve, write_resolved
from netdesign.model.scene import Part
from netdesign.photogrammetry.seating import gap_to_surface
from netdesign.run_folder import run_folder

STUDY = """format = 1
name = "box"
[part]
mesh = "box.stl"
[targets]
size_mm = 20.0
spacing_mm = 45
[camera]
width_px = 2448
height_px = 2048
focal_px = [3600, 3600]
principal_point_px = [1223.5, 1023.5]
[viewpoints]
radius_mm = 600
"""


@pytest.fixture
def study(tmp_path):
    """A function that writes a study with one text replaced, beside a box of 200 x 150 x 100 mm."""
    trimesh.creation.box((200, 150, 100)).export(tmp_path / "box.stl")

    def write(old="", new=""):
        assert old in STUDY
        path = tmp_path / "study.toml"
        path.write_text(STUDY.replace(old, new) if old else STUDY)
        return path

    return write


def test_units_are_converted_once(study):
    task = load_task(study())
    np.testing.assert_allclose(np.ptp(task.scene.part.vertices, axis=0), [0.2, 0.15, 0.1])
    assert task.sphere.radius == pytest.approx(0.6)
    assert task.limits.max_incidence == pytest.approx(np.radians(65))
    edges = np.diff(task.scene.targets.points.reshape(-1, 4, 3), axis=1)
    np.testing.assert_allclose(np.linalg.norm(edges, axis=2), 0.02, rtol=1e-12)


def test_inch_and_pose(study):
    task = load_task(
        study('mesh = "box.stl"', 'mesh = "box.stl"\nunit = "mm"\nposition_mm = [0, 0, 50]\nrotation_deg = [0, 0, 90]')
    )
    np.testing.assert_allclose(task.scene.part.vertices.min(axis=0), [-0.075, -0.1, 0.0], atol=1e-12)


def test_tags_lie_on_faces_and_do_not_overlap(study):
    task = load_task(study())
    targets, half = task.scene.targets, np.array([0.1, 0.075, 0.05])
    heights = np.abs(np.einsum("gi,gi->g", targets.centres, targets.normals))
    np.testing.assert_allclose(heights, np.abs(targets.normals) @ half, atol=1e-12)
    distances = np.linalg.norm(targets.centres[:, None] - targets.centres, axis=2) + np.eye(len(targets.ids))
    assert distances.min() > 0.025
    assert np.all(np.abs(targets.points) <= half + 1e-12)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("radius_mm", "radius", r"viewpoints\.radius: unknown key, the nearest known key is 'radius_mm'"),
        ("[viewpoints]", "[viewpoint]", r"viewpoint: unknown key, the nearest known key is 'viewpoints'"),
        ("box.stl", "none.stl", r"none\.stl: no such file"),
        ("[3600, 3600]", "[0, 3600]", r"camera\.focal_px\.0: expected greater than 0, found 0"),
        ("[3600, 3600]", "[nan, 3600]", r"camera\.focal_px"),
        ("spacing_mm = 45\n", "", r"exactly one of file and spacing_mm"),
        ("spacing_mm = 45", "spacing_mm = 10", r"spacing_mm: expected at least 25"),
        ("size_mm = 20.0", "size_mm = 200.0\nspacing_mm=300\n#", r"no flat face of the part has room"),
        ("radius_mm = 600", "radius_mm = 100", r"radius_mm: expected more than the part's reach of 134\.6 mm"),
        ("radius_mm = 600", "radius_mm = 600\nelevation_deg = [50, 20]", r"elevation_deg: expected low < high"),
        ("radius_mm = 600", "radius_mm = [700, 500]", r"radius_mm: expected low <= high, found \[700\.0, 500\.0\]"),
        ("format = 1", "format = 2", r"format: expected 1, found 2"),
        ("format = 1", "format = ", r"expected TOML"),
        ('name = "box"', "", r"name: expected a value, found none"),
        ('name = "box"', 'name = ""', r"name: expected text, found ''"),
        ("box.stl", ".", r"expected a file, found a folder, named in"),
        ("[3600, 3600]", "3600", r"camera\.focal_px: expected a list in brackets, found 3600"),
        (
            "[camera]",
            "[camera]\ndistortion = [0, 0, 0, 0, 0]",
            r"camera\.distortion: expected a list of 4, found one of 5",
        ),
        ("[camera]", '[objectives]\nmotion = "joint"\n[camera]', r"joint needs a \[robot\] table"),
        (
            "[part]",
            'robot = "ur10"\n[part]',
            r"robot: expected a table \(\[robot\] or key = value in braces\), found 'ur10'",
        ),
    ],
)
def test_mistakes(study, old, new, says):
    text = new.replace("spacing_mm=300\n#", "") if "spacing_mm=300" in new else new
    path = study(old, text)
    if "200.0" in new:
        path.write_text(path.read_text().replace("spacing_mm = 45", "spacing_mm = 300"))
    with pytest.raises(InputError, match=says) as caught:
        load_task(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("vertices", [[[0, 0, 0], [1, 0, 0], [np.nan, 1, 0]], [[0, 0, 0], [1, 0, 0], [2, 0, 0]]])
def test_broken_meshes(study, tmp_path, vertices):
    mesh = trimesh.Trimesh(vertices=vertices, faces=[[0, 1, 2]], process=False)
    (tmp_path / "box.stl").write_bytes(trimesh.exchange.stl.export_stl(mesh))
    with pytest.raises(InputError, match=r"box\.stl: expected"):
        load_task(study())


def test_not_a_mesh(study, tmp_path):
    (tmp_path / "box.stl").write_text("hello")
    with pytest.raises(InputError, match=r"box\.stl: expected a mesh"):
        load_task(study())


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("1,0,0,50,0,0,1,1,0", "expected 10 values"),
        ("1.5,0,0,50,0,0,1,1,0,0", "integer and nine numbers"),
        ("1,0,0,50,0,0,1,1,0,0\n2,14,14,50.5,0,0,1,1,1,0", r"1 pair\(s\) that overlap .*: 1 and 2"),
        ("600,0,0,50,0,0,1,1,0,0", "tag id from 0 to 586"),
        ("0,0,0,50,0,0,0,1,0,0", "a direction"),
        ("0,0,0,50,0,0,1,0,1,1", "right angles"),
        ("0,0,0,50,0,0,1,1,0,0\n0,30,0,50,0,0,1,1,0,0", "twice"),
        ("", "at least one tag"),
    ],
)
def test_wrong_tag_lists(study, tmp_path, line, says):
    (tmp_path / "tags.csv").write_text(f"tag,x_mm,y_mm,z_mm,nx,ny,nz,ux,uy,uz\n{line}\n")
    with pytest.raises(InputError, match=says):
        load_task(study("spacing_mm = 45", 'file = "tags.csv"'))


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_tag_lists_of_spreadsheets(study, tmp_path, mark):
    """Byte order mark, other separators, Windows line ends, comments, ids with a zero behind their point."""
    lines = [
        "tag,x_mm,y_mm,z_mm,nx,ny,nz,ux,uy,uz,glued",
        "3.0,0,0,50,0,0,1,1,0,0,yes",
        "# moved",
        "7,20.2,0,50,0,0,1,1,0,0,no",
    ]
    text = "\r\n".join(["\ufeff" + lines[0], *lines[1:], ""]).replace(",", mark)
    (tmp_path / "tags.csv").write_bytes(text.encode())
    targets = load_task(study("spacing_mm = 45", 'file = "tags.csv"')).scene.targets
    assert targets.ids.tolist() == [3, 7]
    np.testing.assert_allclose(targets.centres, [[0, 0, 0.05], [0.0202, 0, 0.05]], atol=1e-15)


def test_check_names_tags_that_stand_off_the_part(study, tmp_path):
    """In the air, inside, over the edge; and on a cylinder, where corners are off by sqrt(r² + s²/4) - r."""
    rows = ["0,0,0,50,0,0,1,1,0,0", "1,50,0,54.2,0,0,1,1,0,0", "2,-50,0,30,0,0,1,1,0,0", "3,95,40,50,0,0,1,1,0,0"]
    (tmp_path / "tags.csv").write_text("\n".join(["tag,x_mm,y_mm,z_mm,nx,ny,nz,ux,uy,uz", *rows]) + "\n")
    path = study("spacing_mm = 45", 'file = "tags.csv"')
    found = check_study(path)
    assert found.record["gap_mm"] == {
        "1": pytest.approx(4.2, abs=1e-9), "2": pytest.approx(20, abs=1e-9), "3": pytest.approx(5, abs=1e-9)
    }  # fmt: skip
    assert "3 tag(s) do not lie on the part" in found.text
    assert "2 (20 mm), 3 (5 mm), 1 (4.2 mm)" in str(found.problem)
    part = Part(vertices=(cylinder := trimesh.creation.cylinder(40, 200, sections=2000)).vertices, faces=cylinder.faces)
    gap = gap_to_surface(part, np.array([[40, 10, 0], [40, 0, 0], [0, 0, 110], [0, 0, 0], [70, 0, 140]]))
    np.testing.assert_allclose(gap, [np.hypot(40, 10) - 40, 0, 10, 40, 50], atol=2e-4)


def test_check_says_when_the_family_has_no_more_ids(study):
    more = study("size_mm = 20.0\nspacing_mm = 45", "size_mm = 5.0\nspacing_mm = 8\nmin_seen_share = 0.01")
    assert "these are all ids of the family" in check_study(more).text
    assert "all ids" not in check_study(study()).text


def test_cad_is_no_mesh(study, tmp_path):
    (tmp_path / "box.STEP").write_text("ISO-10303-21;")
    with pytest.raises(InputError, match=r"box\.STEP: expected a triangle mesh .* export it as STL"):
        load_task(study("box.stl", "box.STEP"))


@pytest.mark.parametrize(
    ("name", "folder"), [("box", "box"), ("../../x", "..-..-x"), ("..", "run"), ("v1/2 ü", "v1-2 ü"), ("a\\\\b", "a-b")]
)
def test_the_name_is_one_folder_below_runs(study, name, folder):
    resolved = resolve(study('name = "box"', f'name = "{name}"'))
    assert run_folder(resolved, None) == Path("runs") / folder


def test_a_byte_order_mark_is_no_mistake(study):
    path = study()
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert load_task(path).study.name == "box"


def test_a_resolved_run_can_be_moved(study, tmp_path):
    path = study()
    first = resolve(path)
    run = tmp_path / "run"
    write_resolved(first, run)
    moved = tmp_path / "elsewhere"
    run.rename(moved)
    second = resolve(moved / "study.toml")
    assert second.text == first.text
    assert second.sha256 == first.sha256
    assert load_task(moved / "study.toml").sha256 == first.sha256
    assert str(tmp_path) not in (moved / "study.toml").read_text()


def test_the_hash_follows_the_inputs(study, tmp_path):
    before = resolve(study()).sha256
    trimesh.creation.box((200, 150, 101)).export(tmp_path / "box.stl")
    assert resolve(study()).sha256 != before
    assert resolve(study(), seed=7).sha256 != resolve(study()).sha256


def test_tags_that_the_sphere_hardly_sees_can_be_left_out(study):
    every = load_task(study())
    below = every.scene.targets.normals[:, 2] < -0.5  # the box stands on this face
    assert below.any()
    task = load_task(study("spacing_mm = 45", "spacing_mm = 45\nmin_seen_share = 0.01"))
    assert sorted(task.left_out) == sorted(every.scene.targets.ids[below].tolist())
    np.testing.assert_array_equal(task.scene.targets.ids, every.scene.targets.ids[~below])
    np.testing.assert_array_equal(task.scene.targets.points, every.scene.targets.points[np.repeat(~below, 4)])
    with pytest.raises(InfeasibleError, match=r"min_seen_share: none of the \d+ tags is seen from 90.0% of the sphere"):
        load_task(study("spacing_mm = 45", "spacing_mm = 45\nmin_seen_share = 0.9"))


def test_check_says_where_the_lens_folds_the_image(study):
    """r (1 + k1 r²) has its largest value 2/3 sqrt(-1/(3 k1)) at r² = -1/(3 k1)."""
    assert "lens  " not in check_study(study()).text
    path = study("[camera]", "[camera]\ndistortion = [-4, 0, 0, 0]")
    found, focal = check_study(path), load_task(path).camera.focal_px.min()
    assert found.record["fold_px"] == pytest.approx(focal * 2 / 3 * np.sqrt(1 / 12), rel=1e-12)
    assert f"folds the image over {found.record['fold_px']:.0f} px" in found.text


def test_check_says_which_noise_counts(study):
    assert "noise      0.25 px per image coordinate" in check_study(study("[camera]", "[camera]\nsigma_px = 0.25")).text
    both = check_study(study("[camera]", '[camera]\nsigma_px = 0.25\nnoise = "detector"'))
    assert "noise      the detector's model, which takes the place of sigma_px" in both.text
    assert both.record["sigma_px"] is None


def test_check_says_of_stations_that_they_are_no_sphere(study):
    assert "tested over the sphere" in check_study(study()).text
    shells = check_study(study("radius_mm = 600", "radius_mm = [550, 650]")).text
    assert "tested over the admissible stations" in shells
    assert "sphere" not in shells


def test_a_value_of_several_kinds_is_one_problem(study):
    with pytest.raises(InputError, match=r"viewpoints\.roll_deg: expected a valid number or 'free', found 'any'$"):
        load_task(study("radius_mm = 600", 'radius_mm = 600\nroll_deg = "any"'))


def test_a_noise_file_that_would_not_be_used_is_refused(study):
    with pytest.raises(InputError, match='noise_file: expected noise = "detector" beside it'):
        load_task(study("[camera]", '[camera]\nnoise_file = "noise.json"'))


def test_check_says_what_a_depth_of_field_lacks(study):
    assert "sharp" not in check_study(study()).text
    text = check_study(study("[camera]", "[camera]\npixel_um = 3.45\nf_number = 8")).text
    assert "sharp      everywhere: for a depth of field focus_mm is missing" in text


def test_a_distance_to_a_tag_that_is_left_out_says_so(study):
    path = study("spacing_mm = 45", "spacing_mm = 45\nmin_seen_share = 0.01")
    gone = load_task(path).left_out[0]
    path.write_text(
        path.read_text() + f'[requirements]\ndistances = [{{ from = "{gone}.0", to = "0.1", u95_um = 9 }}]\n'
    )
    with pytest.raises(InputError, match=rf"found '{gone}\.0', a tag that targets\.min_seen_share leaves out"):
        check_study(path)
