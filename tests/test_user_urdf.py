"""A user's own URDF: meshes named in any way, what it lacks filled in, one clear line for every defect."""

import re
import shutil

import numpy as np
import pytest

from netdesign.check import check_study
from netdesign.errors import InputError
from netdesign.files.design_json import read_networks
from netdesign.files.store import read_json
from netdesign.files.study import load_task, resolve, write_resolved
from netdesign.main_job import run_study
from netdesign.model.progress import silent
from netdesign.motion.catalogue import find_robot
from netdesign.motion.kinematics import base_from_flange, restarts
from netdesign.motion.robot import load_chain
from tests.test_datasets import DATASETS

LINKS = [
    f'<link name="l{i}"><collision><geometry><sphere radius="0.04"/></geometry></collision></link>' for i in range(7)
]
LIMIT = '<limit lower="-3" upper="3" effort="1" velocity="2"/>'


def arm(joints=6, kinds=None, limit=LIMIT, more=""):
    """A serial arm of revolute joints about z and y in turn, 0.15 m apart."""
    text = "".join(LINKS[: joints + 1])
    for i in range(joints):
        kind = (kinds or {}).get(i, "revolute")
        text += (
            f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="0 0 0.15"/>'
            f'<axis xyz="{"0 0 1" if i % 2 == 0 else "0 1 0"}"/>{limit}</joint>'
        )
    tool = f'<link name="plate"/><joint name="fix" type="fixed"><parent link="l{joints}"/><child link="plate"/></joint>'
    return f'<robot name="mine">{text}{tool}{more}</robot>'


def study(folder, urdf, robot='tool_frame = "plate"'):
    text = (DATASETS / "studies/plate.toml").read_text().replace('"../', f'"{DATASETS.as_posix()}/')
    text = text[: text.index("[objectives]")]
    (folder / "arm.urdf").write_text(urdf)
    (folder / "study.toml").write_text(f'{text}\n[robot]\nurdf = "arm.urdf"\n{robot}\n')
    return folder / "study.toml"


def chain_of(path):
    return load_chain(load_task(path).cell)


DEFECTS = [
    ("", "", "arm.urdf: expected XML, found an error"),
    ("<html/>", "", "arm.urdf: expected the element robot, found html"),
    ('<robot name="a" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include filename="b"/></robot>', "", "xacro"),
    (arm(more='<link name="alone"/>'), "", "Two root links found"),
    (arm(limit=""), "", r"Joint \[j0\] is of type REVOLUTE but it does not specify limits"),
    (arm(limit=LIMIT.replace("-3", "low")), "", r"\[j0\].*not a valid float"),
    (arm(limit=LIMIT.replace("-3", "3")), "", r"limits_rad\.j0: expected low < high, found \[3, 3\] in arm\.urdf"),
    (arm(kinds={2: "prismatic"}), "", "joint j2: expected a revolute .*found a prismatic one; lock it"),
    (arm(5), "", r"expected 6 or 7 joints that move the camera, found 5 \(j0, j1, j2, j3, j4\): too few"),
    (arm(), "lock = { j0 = 0.0 }", "found 5"),
    (arm(), "lock = { jaw = 0.0 }", "robot.lock: expected one of j0, j1.*found 'jaw'"),
    (arm(), "limits_rad = { jaw = [0, 1] }", "robot.limits_rad: expected one of j0, j1.*found 'jaw'"),
    (arm(), 'tool_frame = "plat"', r"robot.tool_frame: .*found 'plat' \(nearest: plate"),
    (arm(), "joint_weights = [1, 1]", r"robot.joint_weights: expected 6 numbers \(j0, j1"),
    (arm(), "joint_weights = [0, 0, 0, 0, 0, 0]", "expected a weight above 0"),
    (re.sub("<collision>.*?</collision>", "", arm()), "", "expected collision geometry"),
    (arm().replace('<sphere radius="0.04"/>', '<mesh filename="gone.stl"/>', 1), "", "mesh gone.stl: no such file"),
    (arm().replace('<sphere radius="0.04"/>', '<mesh filename="package://a/gone.stl"/>', 1), "", "robot.package_dirs"),
]  # fmt: skip


@pytest.mark.parametrize(("urdf", "robot", "message"), DEFECTS)
def test_every_defect_is_one_clear_line(tmp_path, capfd, urdf, robot, message):
    with pytest.raises(InputError, match=message) as found:
        check_study(study(tmp_path, urdf, robot if "tool_frame" in robot else f'tool_frame = "plate"\n{robot}'))
    assert "\n" not in str(found.value)
    assert capfd.readouterr().err == ""


def test_what_a_urdf_lacks_can_be_given(tmp_path):
    limits = "limits_rad = { j0 = [-1, 2], " + ", ".join(f"j{i} = [-3, 3]" for i in range(1, 6)) + " }"
    chain = chain_of(study(tmp_path, arm(limit=""), f'tool_frame = "plate"\n{limits}'))
    assert (chain.lower[0], chain.upper[0]) == (-1, 2)
    assert chain.speed.tolist() == [1.05] * 6
    free = chain_of(study(tmp_path, arm(kinds={0: "continuous", 5: "continuous"})))
    assert free.wraps.tolist() == [True, False, False, False, False, True]


def test_rails_and_grippers(tmp_path):
    rail = (
        '<link name="rail"/><joint name="slide" type="prismatic"><parent link="rail"/><child link="l0"/>'
        '<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )
    jaw = (
        '<link name="jaw"/><joint name="grip" type="prismatic"><parent link="plate"/><child link="jaw"/>'
        '<axis xyz="1 0 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    )
    at_rest = chain_of(study(tmp_path, arm(more=jaw)))
    moved = chain_of(study(tmp_path, arm(more=jaw + rail), 'tool_frame = "plate"\nlock = { slide = 0.3 }'))
    q = restarts(at_rest, 3, seed=1)
    expected = base_from_flange(at_rest, q)
    expected[:, 0, 3] += 0.3
    np.testing.assert_allclose(base_from_flange(moved, q), expected, atol=1e-12)


@pytest.mark.parametrize("style", ["meshes/", "../meshes/", "package://mine/meshes/", "package", "file://"])
def test_meshes_are_found_and_go_with_the_run(tmp_path, style):
    """Visual meshes are not needed; the run directory has its own copies and gives the same arm."""
    folder = tmp_path / "ws/mine/urdf"
    urdf, robot = _own_ur5(tmp_path, folder, style)
    path = study(folder, urdf, robot)
    chain = chain_of(path)
    assert len(chain.shapes) == 7
    write_resolved(resolve(path), tmp_path / "run")
    rerun = resolve(tmp_path / "run/study.toml")
    assert rerun.sha256 == resolve(path).sha256  # what the run's own study gives is the run, byte for byte
    shutil.rmtree(tmp_path / "ws")
    again = chain_of(tmp_path / "run/study.toml")
    for one, other in zip(chain.shapes, again.shapes, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
    assert not any(path.suffix == ".dae" for path in (tmp_path / "run").rglob("*"))


def _own_ur5(tmp_path, folder, style):
    source, (share,), _ = find_robot("ur5")
    text = source.read_text().replace('"tool0"', '"plate"')
    place = {"meshes/": folder, "file://": folder}.get(style, folder.parent) / "meshes"
    prefix = {"package": "package://mine/meshes/", "file://": f"file://{place}/"}.get(style, style)
    folder.mkdir(parents=True)
    for name in set(re.findall(r'filename="(package://[^"]+)"', text)):
        below = name.split("meshes/")[1]
        text = text.replace(name, prefix + below)
        if "collision" in below:
            (place / below).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(share / name.removeprefix("package://"), place / below)
    dirs = {"package://mine/meshes/": "../..", "package": ".."}.get(style)
    return text, 'tool_frame = "plate"' + (f'\npackage_dirs = ["{dirs}"]' if dirs else "")


@pytest.mark.slow
def test_the_main_job_runs_on_a_user_s_arm_of_seven_joints(tmp_path):
    """An xArm7 as a user's URDF with a renamed tool frame: designed, rendered, adjusted, reported (issue 5)."""
    source, _, flange = find_robot("xarm7")
    text = (DATASETS / "studies/panda.toml").read_text().replace('"../', f'"{DATASETS.as_posix()}/')
    text = text.replace('name = "panda"\nbase', 'urdf = "mine.urdf"\ntool_frame = "camera_plate"\nbase').replace(
        "-450", "-420"
    )
    text = text.replace("generations = 60", "generations = 5").replace("max_networks = 5", "max_networks = 2")
    (tmp_path / "study.toml").write_text(text)
    (tmp_path / "mine.urdf").write_text(source.read_text().replace(f'"{flange}"', '"camera_plate"'))
    run = tmp_path / "run"
    run_study(tmp_path / "study.toml", run, seed=None, resume=False, workers=1, progress=silent)
    networks = read_networks(run)
    assert len(networks) == 2
    assert all(network.joints.shape[1] == 7 for network in networks.values())
    verdicts = [entry["verdict"] for entry in read_json(run / "validation.json", "validation")["networks"]]
    assert "failed" not in verdicts
    assert (run / "report.html").is_file()
    assert {"cell.png", "reach.png"} <= {path.name for path in (run / "figures").iterdir()}


def test_a_camera_mount_in_metres_is_noticed(tmp_path):
    mount = "flange_from_cam_mm = [[1, 0, 0, {}], [0, 1, 0, 0], [0, 0, 1, {}], [0, 0, 0, 1]]"
    for values, noticed in (((0.06, 0.08), True), ((60, 80), False), ((0, 0), False)):
        robot = 'tool_frame = "plate"\n' + mount.format(*values)
        text = check_study(study(tmp_path, arm(), robot)).text
        assert ("the camera is 0.1 mm from the flange" in text) is noticed
