"""``netdesign doctor``: is this installation able to do the work, and if not, what to install.

Nothing is repaired. Each check answers with one line; the first thing that is broken becomes the exit status 4.
"""

import importlib
import importlib.metadata
import platform
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from netdesign.errors import EnvironmentProblem

PYTHON_NEEDED = (3, 11)
# Compiled libraries fail when they are loaded, not when they are listed: what each is called in an import.
COMPILED = {
    "scipy": "scipy.linalg",
    "numba": "numba",
    "gtsam": "gtsam",
    "pycolmap": "pycolmap",
    "opencv-contrib-python-headless": "cv2",
    "pin": "pinocchio",
    "moocore": "moocore",
}
# Debian's and Ubuntu's packages of the shared libraries that wheels do not bring.
DEBIAN_PACKAGES = {
    "libgomp.so": "libgomp1",
    "libEGL.so": "libegl1",
    "libGL.so": "libgl1",
    "libXrender.so": "libxrender1",
}
TOLERANCE_PX = 0.02  # a wrong pixel convention is off by 0.5 px, the fit itself by a few thousandths


@dataclass(frozen=True, kw_only=True)
class Check:
    """One question and its answer; ``advice`` says what to do when it is not ``good``."""

    name: str
    good: bool
    found: str
    advice: str = ""

    @property
    def answer(self) -> str:
        """What was found and what to do."""
        return self.found + (f"; {self.advice}" if self.advice else "")


@dataclass(frozen=True, kw_only=True)
class Examination:
    """All checks, in the order in which they were made."""

    checks: tuple[Check, ...]

    @property
    def record(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "good": self.problem is None,
            "checks": [
                {"name": check.name, "good": check.good, "found": check.found, "advice": check.advice}
                for check in self.checks
            ],
        }

    @property
    def text(self) -> str:
        """One line per check."""
        width = max(len(check.name) for check in self.checks)
        return "\n".join(
            f"{'ok  ' if check.good else 'FAIL'} {check.name:{width}}  {check.answer}" for check in self.checks
        )

    @property
    def problem(self) -> EnvironmentProblem | None:
        """The first check that failed, as the error to leave with; None when all is well."""
        for check in self.checks:
            if not check.good:
                return EnvironmentProblem(
                    f"{check.name}: {check.found}" + (f"; {check.advice}" if check.advice else "")
                )
        return None


def doctor() -> Examination:
    """Examine the interpreter, every dependency, drawing without a display, and the image conventions."""
    checks = [_python(), *_dependencies(), *_libraries()]
    if all(check.good for check in checks):
        checks += [_drawing(), _convention("pyrender"), _convention("reference")]
    return Examination(checks=tuple(checks))


def _python() -> Check:
    needed = ".".join(map(str, PYTHON_NEEDED))
    return Check(
        name="python",
        good=sys.version_info >= PYTHON_NEEDED,
        found=f"{platform.python_version()} on {platform.machine()}",
        advice="" if sys.version_info >= PYTHON_NEEDED else f"expected {needed} or newer",
    )


def _dependencies() -> list[Check]:
    """Compare the installed versions with the lower bounds that the package declares."""
    checks = []
    for requirement in importlib.metadata.requires("netdesign") or []:
        parts = re.fullmatch(r"([A-Za-z0-9._-]+)>=([0-9.]+)", requirement)
        if parts is None:  # an extra, which nobody needs to have
            continue
        name, bound = parts[1], parts[2]
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            checks.append(Check(name=name, good=False, found="not installed", advice="install netdesign again"))
            continue
        good = _release(version) >= _release(bound)
        advice = "" if good else f"expected at least {bound}"
        checks.append(Check(name=name, good=good, found=version, advice=advice))
    return checks


def _release(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version: 4.3.0rc1 is (4, 3, 0)."""
    return tuple(int(number) for number in re.findall(r"\d+", re.split(r"[a-z+]", version)[0]))


def _libraries() -> list[Check]:
    """Load every compiled library; return a check for each that cannot be loaded."""
    failed = []
    for distribution, module in COMPILED.items():
        try:
            importlib.import_module(module)
        except (ImportError, OSError) as error:
            reason = " ".join(str(error).split())
            missing = [package for library, package in DEBIAN_PACKAGES.items() if library in reason]
            advice = f"apt-get install {' '.join(missing)}" if missing else f"install {distribution} again"
            failed.append(Check(name=f"import {module}", good=False, found=reason, advice=advice))
    return failed or [Check(name="compiled libraries", good=True, found=f"{len(COMPILED)} load")]


def _drawing() -> Check:
    from netdesign.imaging.render import probe

    return _answer("drawing without a display", probe)


def _convention(renderer: str) -> Check:
    """Draw one tag, measure it, and compare its corners with the collinearity equations."""
    name = f"conventions ({renderer})"

    def compare() -> str:
        error = _tag_error_px(renderer)
        if error > TOLERANCE_PX:
            raise EnvironmentProblem(f"corners {error:.4f} px from their projection, at most {TOLERANCE_PX} expected")
        return f"drawn, measured and projected corners of a tag agree to {error:.4f} px"

    return _answer(name, compare)


def _answer(name: str, question: Callable[[], str]) -> Check:
    try:
        return Check(name=name, good=True, found=question())
    except EnvironmentProblem as problem:
        return Check(name=name, good=False, found=str(problem))


def _tag_error_px(renderer: str) -> float:
    """Return the largest distance of a measured corner of one slanted tag from its projection, without noise."""
    from netdesign.imaging.measure import measure
    from netdesign.imaging.photograph import Photographer, Shoot
    from netdesign.model.camera import Camera
    from netdesign.model.frames import look_at
    from netdesign.model.scene import Part, Scene, Targets
    from netdesign.photogrammetry.collinearity import project

    size = 0.02
    camera = Camera(
        width_px=320,
        height_px=240,
        focal_px=np.array([1200.0, 1200.0]),
        principal_point_px=np.array([157.3, 121.8]),
        distortion=np.array([-0.1, 0.02, 0.0005, -0.0003]),
    )
    targets = Targets(
        ids=np.array([7]),
        centres=np.zeros((1, 3)),
        normals=np.array([[0.0, 0.0, 1.0]]),
        x_axes=np.array([[1.0, 0.0, 0.0]]),
        size_m=size,
    )
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size
    scene = Scene(part=Part(vertices=corners, faces=np.array([[0, 1, 2], [0, 2, 3]])), targets=targets)
    world_from_cam = look_at(np.array([0.08, -0.06, 0.24]), np.zeros(3), 0.3)
    shoot = Shoot(noise=False, renderer="pyrender" if renderer == "pyrender" else "reference")
    picture = Photographer(scene, camera, shoot).take(0, world_from_cam)
    measured = [tag for tag in measure(picture, camera, targets.family, size, [7]) if not tag.rejected]
    if not measured:
        raise EnvironmentProblem("the tag that was drawn is not found in the picture")
    expected, _ = project(world_from_cam, targets.points, camera.intrinsics)
    return float(np.linalg.norm(measured[0].corners_px - expected, axis=1).max())
