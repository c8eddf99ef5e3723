"""Taking a picture: a renderer, then light on the sensor, then grey levels."""

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from netdesign.imaging.looks import Appearance
from netdesign.imaging.optics import Picture, Shading, expose, noise_generator
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
    """

    seed: int = 1
    supersample: int = 4
    renderer: RendererName = "pyrender"
    bits: Literal[8, 16] = 8
    noise: bool = True
    appearance: Appearance = field(default_factory=Appearance)
    shading: Shading = field(default_factory=Shading)


class LightSource(Protocol):
    """What both renderers do."""

    def render(self, world_from_cam: Floats) -> Picture:
        """Return the (h, w) light on the sensor, full scale 1, for a pose (4, 4)."""


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
        return self.expose(self.light(world_from_cam), self.camera, self.shoot, index)

    def light(self, world_from_cam: Floats) -> Picture:
        """Return the (h, w) light on the sensor from a pose (4, 4), shading included."""
        light = self._renderer.render(world_from_cam)
        return light if self._shading is None else light * self._shading

    @staticmethod
    def expose(light: Picture, camera: Camera, shoot: Shoot, index: int) -> NDArray[np.generic]:
        """Return the grey levels of picture ``index``: light (h, w) with the sensor's noise."""
        return expose(light, camera, noise_generator(shoot.seed, index) if shoot.noise else None, shoot.bits)
