"""A camera network and what it observes."""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints, frozen
from netdesign.model.camera import Camera


@dataclass(frozen=True, kw_only=True)
class Network:
    """One camera at n stations.

    Attributes:
        world_from_cam: (n, 4, 4) m, in acquisition order.
    """

    camera: Camera
    world_from_cam: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "world_from_cam", frozen("world_from_cam", self.world_from_cam, ("n", 4, 4)))

    def __len__(self) -> int:
        return len(self.world_from_cam)


@dataclass(frozen=True, kw_only=True)
class Observations:
    """Image points: k rows, image ``image[k]`` sees object point ``point[k]`` at ``xy_px[k]``.

    Attributes:
        image, point: (k,) indices.  xy_px: (k, 2), origin at the centre of the top-left pixel.
        covariance: (k, 2, 2) px².
    """

    image: Ints
    point: Ints
    xy_px: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", frozen("image", self.image, ("k",), np.int64))
        count = len(self.image)
        object.__setattr__(self, "point", frozen("point", self.point, (count,), np.int64))
        object.__setattr__(self, "xy_px", frozen("xy_px", self.xy_px, (count, 2)))
        object.__setattr__(self, "covariance", frozen("covariance", self.covariance, (count, 2, 2)))

    def __len__(self) -> int:
        return len(self.image)

    def select(self, keep: Bools | Ints) -> "Observations":
        """Return the rows chosen by a mask (k,) or by indices."""
        return Observations(
            image=self.image[keep], point=self.point[keep], xy_px=self.xy_px[keep], covariance=self.covariance[keep]
        )
