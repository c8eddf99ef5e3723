"""Taking a picture: a renderer, then light on the sensor, then grey levels."""

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from netdesign.imaging.geometry import through_the_lens
from netdesign.imaging.looks import Appearance
from netdesign.imaging.optics import Picture, Shading, expose, glare, noise_generator
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.imaging.render import Renderer
from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera
from netdesign.model.scene import Scene

RendererName = Literal["pyrender", "reference"]


@dataclass(frozen=True, kw_only=True)
class Shoot:
    """How pictures are taken.

    Attributes:
        seed: of the sensor noise; picture i draws from (seed, i), whatever happens to the others.
        supersample: samples along a pixel.  bits: 8 or 16.  noise: False leaves rounding only.
        lens_samples: points of the lens to average over, for the depth of field of the camera's f-number, pixel pitch
            and focus distance; 0: a pinhole, everything is sharp.
        motion_m: (3,) way of the camera in its own axes during the exposure; the truth is its middle.
        glare: spots of stray light per picture, brighter than white, anywhere.
    """

    seed: int = 1
    supersample: int = 4
    renderer: RendererName = "pyrender"
    bits: Literal[8, 16] = 8
    noise: bool = True
    appearance: Appearance = field(default_factory=Appearance)
    shading: Shading = field(default_factory=Shading)
    lens_samples: int = 0
    motion_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    glare: int = 0


MOTION_SAMPLES = 9  # of an exposure
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


class LightSource(Protocol):
    """What both renderers do."""

    def render(self, cam_from_world: Floats) -> Picture:
        """Return the (h, w) light on the sensor, full scale 1, for a view (4, 4)."""


class Photographer:
    """A scene, a camera and how the pictures are taken."""

    def __init__(self, scene: Scene, camera: Camera, shoot: Shoot) -> None:
        self.camera, self.shoot = camera, shoot
        self._renderer: LightSource = (
            Renderer(scene, camera, shoot.supersample, shoot.appearance)
            if shoot.renderer == "pyrender"
            else ReferenceRenderer(scene, camera, shoot.appearance)
        )
        self._shading = None if shoot.shading == Shading() else shoot.shading.factor(camera)

    def take(self, index: int, world_from_cam: Floats) -> NDArray[np.generic]:
        """Return picture ``index`` (h, w) uint8 or uint16 from a pose (4, 4).

        Raises:
            EnvironmentProblem: the renderer's system libraries are missing.
        """
        light = self.light(world_from_cam)
        if self.shoot.glare:
            light = light + glare(self.camera, self.shoot.glare, np.random.default_rng([self.shoot.seed, index, 1]))
        return self.expose(light, self.camera, self.shoot, index)

    def light(self, world_from_cam: Floats) -> Picture:
        """Return the (h, w) light on the sensor from a pose (4, 4): averaged over lens and exposure, shaded."""
        views = [
            through_the_lens(pose, offset, self.camera.focus_m or 1.0)
            for pose in self._exposure(world_from_cam)
            for offset in self._lens()
        ]
        light = self._renderer.render(views[0])
        for view in views[1:]:
            light = light + self._renderer.render(view)
        light = (light / np.float32(len(views))).astype(np.float32)
        return light if self._shading is None else light * self._shading

    def _lens(self) -> Floats:
        """Return the (k, 2) points of the lens to look through, m: a sunflower's, evenly spread over the disk."""
        camera, count = self.camera, self.shoot.lens_samples
        if count == 0 or camera.pixel_m is None or camera.f_number is None or camera.focus_m is None:
            return np.zeros((1, 2))
        image_distance = float(camera.focal_px[0]) * camera.pixel_m
        focal_length = 1.0 / (1.0 / camera.focus_m + 1.0 / image_distance)
        index = np.arange(count)
        radius = 0.5 * focal_length / camera.f_number * np.sqrt((index + 0.5) / count)
        return np.stack([radius * np.cos(index * GOLDEN_ANGLE), radius * np.sin(index * GOLDEN_ANGLE)], axis=1)

    def _exposure(self, world_from_cam: Floats) -> Floats:
        """Return the (k, 4, 4) poses during the exposure."""
        way = np.asarray(self.shoot.motion_m)
        if not way.any():
            return world_from_cam[None]
        share = (np.arange(MOTION_SAMPLES) + 0.5) / MOTION_SAMPLES - 0.5
        poses = np.repeat(world_from_cam[None], MOTION_SAMPLES, axis=0)
        poses[:, :3, 3] += share[:, None] * (world_from_cam[:3, :3] @ way)
        return poses

    @staticmethod
    def expose(light: Picture, camera: Camera, shoot: Shoot, index: int) -> NDArray[np.generic]:
        """Return the grey levels of picture ``index``: light (h, w) with the sensor's noise."""
        return expose(light, camera, noise_generator(shoot.seed, index) if shoot.noise else None, shoot.bits)
