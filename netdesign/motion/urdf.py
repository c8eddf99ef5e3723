"""A URDF as a user has it, made ready to be loaded: meshes found, what is only looked at left out, limits filled in."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path

from netdesign.errors import InputError

PACKAGE_SCHEME, FILE_SCHEME = "package://", "file://"
_NUMBER = re.compile(r"^\d\d-")


def read_urdf(urdf: Path) -> ElementTree.Element:
    """Return the robot element of a URDF without its visual geometry.

    Raises:
        InputError: no such file, not XML, no robot in it, or xacro that has not been expanded.
    """
    if not urdf.is_file():
        raise InputError(f"robot.urdf: expected a URDF file, found no file {urdf}")
    try:
        robot = ElementTree.fromstring(urdf.read_bytes())
    except ElementTree.ParseError as error:
        raise InputError(f"robot.urdf: {urdf.name}: expected XML, found an error: {error}") from None
    if robot.tag != "robot":
        raise InputError(f"robot.urdf: {urdf.name}: expected the element robot, found {robot.tag}")
    if any("xacro" in element.tag for element in robot.iter()):
        raise InputError(f"robot.urdf: {urdf.name}: expected a URDF, found xacro; expand it first: xacro {urdf.name}")
    for link in robot.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    return robot


def collision_meshes(robot: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """Yield the mesh elements of a robot without visual geometry."""
    for mesh in robot.iter("mesh"):
        if mesh.get("filename"):
            yield mesh


def find_mesh(name: str, urdf: Path, package_dirs: tuple[Path, ...]) -> Path:
    """Return the file of a mesh: package:// below a package directory (or in the package itself), else beside the URDF.

    Raises:
        InputError: there is none.
    """
    if name.startswith(PACKAGE_SCHEME):
        below = name.removeprefix(PACKAGE_SCHEME)
        package, _, rest = below.partition("/")
        candidates = [folder / below for folder in package_dirs]
        candidates += [folder / rest for folder in package_dirs if folder.resolve().name == package]
        where = f"in none of robot.package_dirs ({', '.join(str(folder) for folder in package_dirs[:-1]) or 'empty'})"
    else:
        candidates = [urdf.parent / name.removeprefix(FILE_SCHEME)]
        where = "no such file"
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise InputError(f"{urdf}: mesh {name}: {where}")


def prepared_urdf(urdf: Path, package_dirs: tuple[Path, ...], limits: Mapping[str, tuple[float, float]]) -> str:
    """Return the text of a URDF with the paths of its meshes absolute.

    Args:
        limits: joint name to (low, high) rad; fills in what a revolute joint lacks, and what cannot be read.

    Raises:
        InputError: see ``read_urdf`` and ``find_mesh``.
    """
    robot = read_urdf(urdf)
    for mesh in collision_meshes(robot):
        mesh.set("filename", str(find_mesh(mesh.attrib["filename"], urdf, package_dirs).resolve()))
    for joint in robot.findall("joint"):
        name = joint.get("name", "")
        if joint.get("type") == "revolute" and name in limits and joint.find("limit") is None:
            low, high = limits[name]
            values = {"lower": repr(low), "upper": repr(high), "effort": "0", "velocity": "0"}
            ElementTree.SubElement(joint, "limit", values)
    return ElementTree.tostring(robot, encoding="unicode")


def bundled_urdf(urdf: Path, package_dirs: tuple[Path, ...], shared: Path) -> tuple[str, dict[str, Path]]:
    """Return a URDF whose meshes lie beside it in meshes/, and those files by their new names.

    Args:
        shared: folder of the installed robot packages: what lies there is named as it was and not copied.

    Raises:
        InputError: see ``read_urdf`` and ``find_mesh``.
    """
    robot = read_urdf(urdf)
    files: dict[str, Path] = {}
    names: dict[Path, str] = {}
    for mesh in collision_meshes(robot):
        found = find_mesh(mesh.attrib["filename"], urdf, package_dirs).resolve()
        if found.is_relative_to(shared.resolve()):
            continue
        if found not in names:
            # A run's own URDF has numbered meshes already; its study has to give the same run.
            names[found] = f"meshes/{len(names):02d}-{_NUMBER.sub('', found.name)}"
            files[names[found]] = found
        mesh.set("filename", names[found])
    return ElementTree.tostring(robot, encoding="unicode") + "\n", files
