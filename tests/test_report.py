"""The report: whole without a network, nothing dropped, the same bytes each time, and its pictures obey geometry."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

from netdesign.errors import InputError
from netdesign.files.store import read_json, write_json
from netdesign.model.scene import Part
from netdesign.model.stations import Depth
from netdesign.motion.collision import REASONS
from netdesign.motion.kinematics import forward
from netdesign.motion.robot import load_chain
from netdesign.report import read_run, write_report
from netdesign.reporting import arm, charts, drawing, mesh, palette, payload, reach, words
from tests import cells
from tests.runs import fail, pool_run, prove, ring_run
from tests.scenes import CAMERA, box_part, ring, sphere

FAILURE = "tag 14 was found in 2 images only"


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """A run after ``design`` alone."""
    run = tmp_path_factory.mktemp("designed")
    ring_run(run, sizes=(8, 10))
    return run, write_report(run).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def proved(tmp_path_factory):
    """A run with one network proved, one with more noise than predicted, one that could not be adjusted."""
    run = tmp_path_factory.mktemp("proved")
    task = ring_run(run, sizes=(8,))
    prove(run, task, networks=[0])
    prove(run, task, networks=[1], noise=1.5)
    fail(run, task, 2, FAILURE)
    pool_run(run, task)
    return run, write_report(run).read_text(encoding="utf-8")


VOID = {"meta", "link", "img", "br", "input", "hr", "circle", "line", "rect", "polyline"}


class Loads(HTMLParser):
    """Collects what a page would fetch, and checks that its elements close."""

    def __init__(self):
        super().__init__()
        self.found, self.open = [], []

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            if name in ("src", "href", "data", "action", "poster", "srcset"):
                self.found.append(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag


def without_plotly(page):
    """Return the page less the plotly bundle, which quotes addresses that nothing here asks for."""
    return re.sub(r"<script>/\*\*\n\* plotly\.js.*?</script>", "", page, flags=re.DOTALL)


def test_the_page_loads_nothing(designed, proved):
    for _, page in (designed, proved):
        parser = Loads()
        parser.feed(page)
        assert not parser.open
        assert all(value.startswith(("#", "data:image/")) for value in parser.found)
        own = without_plotly(page)
        assert len(own) < len(page) - 4e6
        assert not re.search(r"https?:|@import|url\(", own)
        assert page.count("plotly.js v") >= 1
        assert len(page) < 8e6


def test_every_network_is_in_the_table_in_detail_and_in_the_data(designed):
    run, page = designed
    design = read_json(run / "design.json", "design")
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, flags=re.DOTALL)[1])
    assert [network["id"] for network in data["networks"]] == [network["id"] for network in design["networks"]]
    for network in design["networks"]:
        assert '<article class="network card' in page
        assert f'id="network-{network["id"]:04d}"' in page
        assert f'<tr data-id="{network["id"]}"' in page
        assert (run / "figures" / f"network-{network['id']:04d}.png").read_bytes().startswith(b"\x89PNG")
    assert (run / "figures" / "front.png").is_file()
    assert page.count("Designed, not proved yet") == 1


def test_failures_and_verdicts_appear_with_their_reasons(proved):
    run, page = proved
    assert page.count(FAILURE) >= 2  # in its own article and among the flags
    assert "1 of " in page
    text = re.sub(r"<[^>]+>", " ", without_plotly(page))
    for number in (0, 1):
        content = read_json(run / f"networks/{number:04d}/validation.json", "network-validation")
        assert f"{content['statistics']['rho']['value']:.3f}" in text
        for reason in content["reasons"]:
            assert reason in text
    assert read_json(run / "networks/0001/validation.json", "network-validation")["reasons"]
    campaign = read_json(run / "validation.json", "validation")
    assert campaign["statement"] in text
    assert f"{campaign['achieved_over_predicted']['total']:.3f}" in text
    assert (run / "figures" / "achieved.png").is_file()


def test_every_sigma_has_its_datum(proved):
    text = re.sub(r"<[^>]+>", " ", without_plotly(proved[1]))
    assert "inner constraints over all object points" in text
    assert "exterior orientation error-free" in text


def test_the_same_run_gives_the_same_bytes(proved):
    run, page = proved
    pictures = {path.name: path.read_bytes() for path in (run / "figures").iterdir()}
    assert write_report(run).read_text(encoding="utf-8") == page
    assert {path.name: path.read_bytes() for path in (run / "figures").iterdir()} == pictures
    assert str(run) not in page


def test_names_from_the_study_cannot_break_the_page(tmp_path):
    ring_run(tmp_path / "run", sizes=(8,))
    study = tmp_path / "run" / "study.toml"
    study.write_text(study.read_text().replace("box-workspace", "</script><b>&amp;"))
    page = write_report(tmp_path / "run").read_text(encoding="utf-8")
    parser = Loads()
    parser.feed(page)
    assert not parser.open
    assert "</script><b>" not in page


def test_sigmas_of_another_run_are_noticed(tmp_path):
    ring_run(tmp_path / "run", sizes=(8,))
    design = read_json(tmp_path / "run" / "design.json", "design")
    design["networks"][0]["sigma_um"][5][1] *= 1.01
    write_json(tmp_path / "run" / "design.json", "design", design)
    record = read_run(tmp_path / "run")
    assert record.recomputed == pytest.approx(0.01, rel=1e-6)
    assert "do not belong together" in words.all_flags(record)[0]["text"]


def test_a_folder_that_is_no_run_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="run directory"):
        write_report(tmp_path)


def test_feature_edges_of_a_box_are_its_twelve_edges():
    part = box_part()
    edges = mesh.feature_edges(part.vertices, part.faces)
    lengths = np.linalg.norm(np.diff(part.vertices[edges], axis=1)[:, 0], axis=1)
    assert sorted(np.round(lengths, 9)) == sorted([0.24, 0.20, 0.16] * 4)


def test_what_stands_behind_the_part_is_hidden():
    part = mesh.PartMesh.of(box_part(), 100)
    eye = np.array([0.0, 0.0, 1.0])
    points = np.array([[0, 0, 0.08], [0, 0, -0.08], [0.11, 0.09, -0.2], [0.13, 0, -0.2], [0, 0, 0.3]])
    assert mesh.hidden(part.tree, points, eye).tolist() == [False, True, True, False, False]


def test_a_light_mesh_keeps_within_its_limit_and_near_the_surface():
    steps = np.linspace(0, 2 * np.pi, 81)[:-1]
    heights = np.linspace(-1, 1, 60)
    vertices = np.array([[np.cos(a), np.sin(a), z] for z in heights for a in steps])
    faces = [
        face
        for row in range(59)
        for k in range(80)
        for a, b in [(row * 80 + k, row * 80 + (k + 1) % 80)]
        for face in ((a, b, b + 80), (a, b + 80, a + 80))
    ]
    part = Part(vertices=vertices, faces=faces)
    light, triangles = mesh.light_mesh(part, 2000)
    assert 200 < len(triangles) <= 2000
    assert np.allclose(np.hypot(light[:, 0], light[:, 1]), 1.0)
    assert mesh.light_mesh(part, 10**6)[1] is not None


def test_a_projected_ellipsoid_is_the_outline_of_its_points():
    random = np.random.default_rng(5)
    root = random.normal(size=(3, 3))
    view = drawing.View(azimuth=0.7, elevation=0.4)
    assert np.allclose(view.axes @ view.axes.T, np.eye(3))
    sphere = random.normal(size=(20000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    outline = view.flat(sphere @ root.T)
    axes = Figure().add_subplot()
    drawing.draw_ellipsoids(axes, view, np.zeros((1, 3)), (root @ root.T)[None], 1.0, "#000000", np.array([True]))
    (ellipse,) = axes.collections
    angle = np.radians(ellipse.get_angles()[0])
    half = np.array([ellipse.get_widths()[0], ellipse.get_heights()[0]]) / 2
    turned = outline @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    reach = np.linalg.norm(turned / half, axis=1)
    assert reach.max() <= 1 + 1e-9
    assert reach.max() > 0.9999


def test_frusta_pass_through_the_image_corners():
    poses = ring(3)
    lines = drawing.frustum_lines(CAMERA, poses, 0.1)
    assert lines.shape == (3, 8, 2, 3)
    assert np.allclose(lines[:, :4, 0], poses[:, None, :3, 3])
    axis = poses[:, :3, 2]
    assert np.allclose(np.einsum("nci,ni->nc", lines[:, :4, 1] - poses[:, None, :3, 3], axis), 0.1)


def test_the_drawn_arm_stands_where_the_kinematics_say():
    cell = cells.cell()
    chain = load_chain(cell)
    drawn = arm.Arm.of(cell, chain)
    joints = np.random.default_rng(2).uniform(-2, 2, (4, len(chain)))
    for row, base_from_flange in zip(joints, forward(chain.placements, chain.last_from_flange, joints), strict=True):
        world_from_cam = cell.world_from_base @ base_from_flange @ cell.flange_from_cam
        assert np.allclose(drawn.world_from_links(row)[-1] @ drawn.last_from_cam, world_from_cam, atol=1e-12)
    assert sum(len(faces) for _, faces in drawn.posed(joints[0])) > 1000


def test_every_reason_of_the_map_has_a_colour_and_a_share():
    assert set(reach.COLOURS) == set(REASONS)
    found = reach.Reach(viewpoints=np.zeros((4, 2)), reasons=("out of reach", "free", "free", "free"))
    assert list(found.shares().items()) == [("free", 0.75), ("out of reach", 0.25)]


def test_the_caption_of_the_reach_tells_what_its_dots_stand_for():
    on_sphere = words.reach_caption(sphere())
    assert "share of the sphere" in on_sphere
    for high, told in ((0.7, True), (0.5, False)):
        shell = replace(sphere(), depth=Depth(shape="ellipsoid", low=np.full(3, 0.5), high=np.full(3, high)))
        caption = words.reach_caption(shell)
        assert "sphere" not in caption
        assert "share of the directions" in caption
        assert ("the nearest, the middle and the farthest" in caption) == told


def test_distances_have_a_disc_each_in_the_picture_of_the_reach():
    wide = replace(sphere(), depth=Depth(shape="ellipsoid", low=np.full(3, 0.5), high=np.full(3, 0.7)))
    viewpoints = np.column_stack([np.zeros((9, 2)), np.tile([0.0, 0.5, 1.0], 3)])
    found = reach.Reach(viewpoints=viewpoints, reasons=("free", "free", "out of reach") * 3)
    assert [name for name, _ in found.shells()] == ["nearest stations", "halfway", "farthest stations"]
    assert (np.array([own for _, own in found.shells()]).sum(axis=0) == 1).all()
    figure = Figure()
    colours = np.array([reach.COLOURS[reason] for reason in found.reasons])
    reach._discs(figure, found, colours, wide.cameras(viewpoints[:3])[:, :3, 3])
    drawn = [{tuple(rgba) for rgba in axes.collections[0].get_facecolors()} for axes in figure.axes]
    assert len(drawn) == 4
    assert [len(colours) for colours in drawn[:3]] == [1, 1, 1]  # no disc mixes two distances
    assert drawn[0] == drawn[1] != drawn[2]
    alone = reach.Reach(viewpoints=viewpoints[:, :2], reasons=found.reasons)
    assert len(alone.shells()) == 1


def test_a_gridded_box_is_closed_and_faces_outwards():
    vertices, faces = arm.box_mesh(np.array([1.0, 2.0, 3.0]), np.array([0.2, 0.3, 0.5]), steps=3)
    corners = vertices[faces] - [1.0, 2.0, 3.0]
    assert np.isclose(np.linalg.det(corners).sum() / 6, 0.03)
    assert np.isclose(0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
                                           axis=1).sum(), 2 * (0.06 + 0.15 + 0.1))  # fmt: skip


def test_no_image_can_be_lost_for_free(proved):
    for network in read_run(proved[0]).networks:
        assert len(network.without) == network.images
        assert (network.without >= 1e-6 * network.rms_um * (1 - 1e-12)).all()


def test_a_gap_between_design_and_measurement_is_flagged_with_its_cause(proved):
    network = read_run(proved[0]).networks[0]
    assert words.design_gap(network) == []
    points = network.adjustment["points"]
    quiet = [{**item, "sigma_apriori_mm": [0.1 * value for value in item["sigma_apriori_mm"]]} for item in points]
    (text,) = words.design_gap(replace(network, adjustment={**network.adjustment, "points": quiet}))
    assert "0.1 times" in text
    assert "not that of the detector" in text
    short = [{**points[0], "rays": int(network.rays[0]) - 1}, *points[1:]]
    told = {**network.validation, "predicted_rms_um": {"used": 2 * network.total_rms_um}}
    (text,) = words.design_gap(replace(network, validation=told, adjustment={**network.adjustment, "points": short}))
    assert f"lost rays to tags that were not found or not used: {points[0]['id']}" in text


PLAY = """<script>
const motion = document.getElementById("plot-motion"), table = document.getElementById("table");
motion.emit("plotly_click", { points: [{ customdata: 2 }] });
motion.emit("plotly_selected", { points: [{ customdata: 0 }, { customdata: 2 }] });
table.querySelector("th[data-key=tour] button").click();
table.querySelector("th[data-key=tour] button").click();
document.querySelector("article.shown details.points").open = true;
</script>"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_a_browser_draws_every_figure_and_selects_brushes_and_sorts(proved, tmp_path):
    (tmp_path / "play.html").write_text(proved[1].replace("</body>", PLAY + "</body>"), encoding="utf-8")
    command = [
        "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        f"--user-data-dir={tmp_path / 'profile'}", "--enable-unsafe-swiftshader", "--use-angle=swiftshader",
        "--virtual-time-budget=20000", "--enable-logging=stderr", "--dump-dom", f"file://{tmp_path / 'play.html'}",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert "Uncaught" not in done.stderr
    page = done.stdout
    assert len(re.findall(r'class="plot[^"]*js-plotly-plot', page)) == 7
    assert re.findall(r'class="network card shown" id="network-(\d+)"', page) == ["0002"]
    rows = re.findall(r'<tr data-id="(\d+)" tabindex="0"([^>]*)>', page)
    assert {number for number, state in rows if "dim" in state} == {number for number, _ in rows} - {"0", "2"}
    design = read_json(proved[0] / "design.json", "design")
    tours = {str(network["id"]): network["objectives"][1] for network in design["networks"]}
    assert [number for number, _ in rows] == sorted(tours, key=tours.get, reverse=True)
    opened = re.search(r'<details class="points[^>]*open.*?</details>', page, flags=re.DOTALL)[0]
    assert opened.count("<tr>") == 1 + len(design["points"])


def test_interval_rows_say_inside_or_outside():
    inside = charts.IntervalRow(label="F", note="", value=1.0, low=0.9, high=1.1)
    outside = charts.IntervalRow(label="<T>", note="", value=1.2, low=0.9, high=1.1)
    chart = charts.interval_chart([inside, outside], "99 %")
    assert chart.count('class="good"') == 1
    assert chart.count('class="bad"') == 1
    assert "&lt;T&gt;" in chart
    assert charts.interval_chart([], "99 %") == ""


def test_undetermined_numbers_become_null_and_scripts_stay_closed():
    assert payload.significant(float("inf"), 4) is None
    assert payload.significant(123456.0, 3) == 123000.0
    assert "</" not in payload.as_script({"name": "</script>"})
    assert len(set(palette.ordered([3, 3, 5, 9]))) == 3
