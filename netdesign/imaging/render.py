"""Pictures of a scene through pyrender on EGL: the only file that meets pyrender and OpenGL.

What is done here and why (measured in the project's imaging notes): flat shading, because anything else applies a
gamma curve and shifts every edge once pixels are averaged; supersampling without multisampling, because the shader
smooths the edges inside a tag and multisampling only costs; vertices in the camera frame with the camera at the
identity; shaders of our own, because filtered textures alias by 0.02 px on tags that stand square to the pixel grid
(``shaders/flat.frag``); horizontal bands, so that memory stays bounded at any resolution. One OpenGL context per
process, used from the thread that made it, never across a fork: start worker processes with "spawn".

Pixel origin: pyrender measures from the corner of the picture, hence +0.5 on the principal point. Camera axes:
OpenGL's y points up and z backwards, hence the sign change of both in ``_gl``.
"""

import os
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from netdesign.errors import EnvironmentProblem, InputError
from netdesign.imaging.geometry import FACE_STEP_PX, TagQuad, divided, face_levels, part_triangles, tag_quads
from netdesign.imaging.looks import Appearance
from netdesign.imaging.optics import Picture, decimate, margin_px
from netdesign.imaging.tags import QUIET_CELLS, texture
from netdesign.model.arrays import Floats, Ints
from netdesign.model.camera import Camera
from netdesign.model.frames import transform
from netdesign.model.scene import Scene

PACKAGES = "libegl1 libgl1"  # Debian and Ubuntu; they pull Mesa's software rasteriser
MAX_SIDE = 16384  # of a render target
BAND_SAMPLES = 2**25  # supersamples of one band: 270 MB of colour and depth
SHADERS = Path(__file__).parent / "shaders"
# The shader's smoothing beyond a supersample's own width, supersamples squared: 1/12 of 1 for an edge along the grid,
# of 0.7 on average for one that leans.
SMOOTHED = 0.8 / 12
PADDING = 1  # cells of white around the quiet zone: the texture's edge is not to show


def probe() -> str:
    """Return what OpenGL calls its renderer.

    Raises:
        EnvironmentProblem: EGL or OpenGL is missing; the message names the Debian packages.
    """
    gl = _offscreen(64, 64).gl
    return f"{gl.glGetString(gl.GL_RENDERER).decode()}, OpenGL {gl.glGetString(gl.GL_VERSION).decode()}"


def check_width(camera: Camera, supersample: int) -> None:
    """Refuse pictures that OpenGL cannot draw.

    Raises:
        InputError: with the way out.
    """
    if camera.width_px * supersample > MAX_SIDE:
        raise InputError(
            f"camera.width_px: OpenGL draws at most {MAX_SIDE} samples across, found {camera.width_px} px x "
            f"supersample {supersample}; lower supersample or use --renderer reference"
        )


class Renderer:
    """Draws one scene with one camera."""

    def __init__(self, scene: Scene, camera: Camera, supersample: int = 4, appearance: Appearance | None = None):
        """Prepare the scene; the OpenGL context is made at the first picture.

        Raises:
            InputError: the picture is too wide.
        """
        check_width(camera, supersample)
        self.scene, self.camera, self.supersample = scene, camera, supersample
        self.appearance = appearance or Appearance()
        self._textures: dict[int, Any] = {}
        self._divided: dict[float, tuple[Floats, Ints]] = {}
        self._face_level = face_levels(scene.part, self.appearance)

    def render(self, cam_from_world: Floats) -> Picture:
        """Return the (h, w) light on the sensor, full scale 1, blurred by the optics and integrated over pixels.

        Args:
            cam_from_world: (4, 4) m; rigid, or one of ``geometry.through_the_lens``.

        Raises:
            EnvironmentProblem: EGL or OpenGL is missing.
        """
        camera, factor = self.camera, self.supersample
        margin = margin_px(camera.blur_px)
        rows = max(1, min(BAND_SAMPLES // (factor**2 * camera.width_px), MAX_SIDE // factor) - 2 * margin)
        rows = min(rows, camera.height_px)
        picture = np.empty((camera.height_px, camera.width_px), np.float32)
        with _Drawing(self._primitives(cam_from_world), self.appearance.background) as drawing:
            for first in range(0, camera.height_px, rows):
                wanted = min(rows, camera.height_px - first)
                fine = drawing.band(camera, factor, first - margin, rows + 2 * margin)
                picture[first : first + wanted] = decimate(fine, camera.blur_px, factor, margin, wanted, SMOOTHED)
        return picture

    def _primitives(self, cam_from_world: Floats) -> list[Any]:
        """Return the tags and the part as pyrender primitives in OpenGL's camera frame."""
        primitive, material = _pyrender().Primitive, _pyrender().MetallicRoughnessMaterial
        quads = tag_quads(self.scene.targets, self.camera, cam_from_world)
        drawn = [
            primitive(
                positions=_gl(quad.vertices), indices=quad.faces,
                texcoord_0=_texture_places(quad, self.scene.targets.cells),
                material=material(baseColorTexture=self._texture(quad), baseColorFactor=[1.0, 1.0, 1.0, 1.0]),
            )
            for quad in quads
        ]  # fmt: skip
        triangles, face = self._part_faces(cam_from_world)
        bent, usable = part_triangles(triangles, self.camera, cam_from_world, nearest=1e-3)
        if usable.any():
            level = np.repeat(self._face_level[face[usable]], 3)
            color = np.stack([level, level, level, np.ones_like(level)], axis=1).astype(np.float32)
            drawn.append(
                primitive(
                    positions=_gl(bent[usable].reshape(-1, 3)), color_0=color,
                    material=material(baseColorFactor=[1.0, 1.0, 1.0, 1.0], doubleSided=True),
                )
            )  # fmt: skip
        return drawn

    def _part_faces(self, cam_from_world: Floats) -> tuple[Floats, Ints]:
        """Return the part's triangles, divided as finely as this view needs under distortion."""
        part = self.scene.part
        if not self.camera.distortion.any():
            return part.triangles, np.arange(len(part.faces))
        distance = np.linalg.norm(transform(cam_from_world, part.vertices), axis=1).min()
        longest = FACE_STEP_PX * max(float(distance), 0.05) / float(self.camera.focal_px.max())
        longest = float(2 ** np.floor(np.log2(longest)))  # few distinct values: divide once, use for many views
        if longest not in self._divided:
            self._divided[longest] = divided(part, longest)
        return self._divided[longest]

    def _texture(self, quad: TagQuad) -> Any:
        if quad.tag not in self._textures:
            targets, look = self.scene.targets, self.appearance
            image = texture(targets.family, int(targets.ids[quad.tag]), PADDING, look.black, look.white)
            self._textures[quad.tag] = _pyrender().Texture(source=image, source_channels="R")
        return self._textures[quad.tag]


def _texture_places(quad: TagQuad, cells: int) -> NDArray[np.float32]:
    """Return where the vertices lie on the texture, which has PADDING around the quiet zone."""
    side = cells + 2 * QUIET_CELLS
    return np.asarray((quad.uv * side + PADDING) / (side + 2 * PADDING), np.float32)


def _gl(vertices: Floats) -> NDArray[np.float32]:
    return (vertices * (1.0, -1.0, -1.0)).astype(np.float32)


class _Drawing:
    """A pyrender scene in OpenGL memory; leaves nothing behind."""

    def __init__(self, primitives: list[Any], background: float):
        pyrender = _pyrender()
        depths = np.concatenate([-item.positions[:, 2] for item in primitives] or [np.ones(1)])
        self._near, self._far = 0.9 * float(depths.min()), 1.1 * float(depths.max())
        self._scene = pyrender.Scene(bg_color=[background, background, background, 1.0])
        for item in primitives:
            self._scene.add(pyrender.Mesh([item]))

    def __enter__(self) -> "_Drawing":
        return self

    def __exit__(self, *_: object) -> None:
        _offscreen(64, 64).clear(self._scene)

    def band(self, camera: Camera, factor: int, first_row: int, rows: int) -> NDArray[np.uint8]:
        """Return (rows·factor, width·factor) grey levels of a band that begins at pixel row ``first_row``."""
        fx, fy = camera.focal_px * factor
        cx, cy = (camera.principal_point_px + 0.5 - (0, first_row)) * factor
        node = self._scene.add(
            _pyrender().IntrinsicsCamera(fx, fy, cx, cy, znear=self._near, zfar=self._far), pose=np.eye(4)
        )
        fine: NDArray[np.uint8] = _offscreen(camera.width_px * factor, rows * factor).draw(self._scene)
        self._scene.remove_node(node)
        return fine


@lru_cache(maxsize=1)
def _pyrender() -> Any:
    """Import pyrender for EGL on a machine without a display.

    Raises:
        EnvironmentProblem: a system library is missing.
    """
    os.environ["PYOPENGL_PLATFORM"] = "egl"
    os.environ.setdefault("LP_NUM_THREADS", "1")  # one worker process per core renders, not one thread
    if not hasattr(np, "infty"):
        setattr(np, "infty", np.inf)  # noqa: B010  # pyrender 0.1.45 predates numpy 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations inside third-party modules
        import pyglet

        pyglet.options["headless"] = True  # or its window module asks for an X display
        try:
            import pyrender
            import pyrender.platforms.egl
        except (ImportError, AttributeError, OSError) as error:
            raise _missing(error) from None
    return pyrender


def _missing(error: Exception) -> EnvironmentProblem:
    reason = " ".join(str(error).split()) or type(error).__name__
    return EnvironmentProblem(
        f"rendering needs EGL and OpenGL: apt-get install --no-install-recommends {PACKAGES} "
        f"(or use the reference renderer); found: {reason}"
    )


@lru_cache(maxsize=1)
def _context() -> Any:
    """Make this process's one OpenGL context and our slim pyrender back end in it."""
    pyrender = _pyrender()
    import OpenGL.error
    from OpenGL import GL as gl
    from pyrender.renderer import Renderer as Stock
    from pyrender.shader_program import ShaderProgramCache

    class Slim(Stock):
        """pyrender's renderer with a plain framebuffer: no multisampling, red channel only."""

        gl: Any = None
        _main_fb: Any
        _main_fb_dims: Any

        def _configure_main_framebuffer(self) -> None:
            size = (self.viewport_width, self.viewport_height)
            if self._main_fb is not None and size == self._main_fb_dims:
                return
            self._delete_main_framebuffer()
            self._main_cb, self._main_db = gl.glGenRenderbuffers(2)
            self._main_fb = self._main_fb_ms = gl.glGenFramebuffers(1)
            gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, self._main_fb)
            for buffer, kind, place in (
                (self._main_cb, gl.GL_RGBA, gl.GL_COLOR_ATTACHMENT0),
                (self._main_db, gl.GL_DEPTH_COMPONENT24, gl.GL_DEPTH_ATTACHMENT),
            ):
                gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
                gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, kind, *size)
                gl.glFramebufferRenderbuffer(gl.GL_DRAW_FRAMEBUFFER, place, gl.GL_RENDERBUFFER, buffer)
            self._main_fb_dims = size

        def _delete_main_framebuffer(self) -> None:
            if self._main_fb is not None:
                gl.glDeleteFramebuffers(1, [self._main_fb])
                gl.glDeleteRenderbuffers(2, [self._main_cb, self._main_db])
            self._main_fb = self._main_fb_ms = self._main_cb = self._main_db = None
            self._main_fb_dims = (None, None)

        def _read_main_framebuffer(self, scene: Any, flags: int) -> NDArray[np.uint8]:
            width, height = self._main_fb_dims
            gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self._main_fb)
            gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
            data = gl.glReadPixels(0, 0, width, height, gl.GL_RED, gl.GL_UNSIGNED_BYTE)
            return np.frombuffer(data, np.uint8).reshape(height, width)[::-1]

        def draw(self, scene: Any) -> NDArray[np.uint8]:
            flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.OFFSCREEN
            grey: NDArray[np.uint8] = self.render(scene, flags)
            return grey

        def clear(self, scene: Any) -> None:
            """Take the scene's meshes out of OpenGL memory; textures go with them."""
            empty = pyrender.Scene()
            empty.add(pyrender.IntrinsicsCamera(1, 1, 1, 1))
            self._update_context(empty, pyrender.RenderFlags.FLAT)

    try:
        from pyrender.platforms.egl import EGLPlatform, get_device_by_index

        platform = EGLPlatform(64, 64, device=get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0"))))
        platform.init_context()
        platform.make_current()
        slim = Slim(64, 64)
        slim._program_cache = ShaderProgramCache(str(SHADERS))
    except (ImportError, AttributeError, ValueError, OpenGL.error.Error) as error:
        raise _missing(error) from None
    slim.gl, slim.platform = gl, platform
    return slim


def _offscreen(width: int, height: int) -> Any:
    """Return the back end with its viewport set."""
    slim = _context()
    slim.viewport_width, slim.viewport_height = width, height
    return slim
