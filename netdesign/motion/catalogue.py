"""The arms that come with example-robot-data, and how a camera sits on a flange when a study says nothing else."""

import importlib.metadata
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from netdesign.errors import EnvironmentProblem, InputError
from netdesign.model.arrays import Floats
from netdesign.model.frames import pose

# Frame of the bare flange of the arms of example-robot-data.
_FLANGES = {
    "panda": "panda_link8",
    "xarm7": "link_eef",
    "kinova": "j2s6s200_end_effector",
    "z1": "link06",
}


def find_robot(name: str) -> tuple[Path, tuple[Path, ...], str | None]:
    """Return (URDF, package directories, flange frame) of a robot of example-robot-data.

    The flange is None for a robot whose flange is not known here: the study then names ``tool_frame``.

    Raises:
        EnvironmentProblem: example-robot-data is not installed.
        InputError: no such robot; names the nearest ones.
    """
    try:
        files = importlib.metadata.files("example-robot-data") or []
    except importlib.metadata.PackageNotFoundError:
        raise EnvironmentProblem(
            "robot models: expected the package example-robot-data, found none installed"
        ) from None
    known = {file.name.removesuffix(".urdf"): file for file in files if file.name.endswith(".urdf")}
    found = known.get(f"{name}_robot") or known.get(name)
    if found is None:
        names = sorted({stem.removesuffix("_robot") for stem in known})
        near = get_close_matches(name, names, n=4, cutoff=0.4) or ["ur3", "ur5", "ur10", *_FLANGES]
        raise InputError(f"robot.name: expected a robot of example-robot-data ({', '.join(near)}, …), found {name!r}")
    urdf = Path(str(found.locate())).resolve()
    # package://example-robot-data/robots/… is resolved against the folder that holds the package's folder.
    share = next(parent for parent in urdf.parents if parent.name == "share")
    return urdf, (share,), _FLANGES.get(name, "tool0" if name.startswith("ur") else None)


def mount(name: str) -> Floats:
    """Return flange_from_cam (4, 4) m of the two camera mounts: "side" looks along flange y, "coaxial" along z.

    Raises:
        InputError: another name.
    """
    if name == "side":
        return pose(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0.0, 0.06, 0.06]))
    if name == "coaxial":
        return pose(np.eye(3), np.array([0.0, 0.0, 0.09]))
    raise InputError(f'robot.camera_mount: expected "side" or "coaxial", found {name!r}')
