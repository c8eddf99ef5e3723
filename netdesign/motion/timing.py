"""How long a leg takes: straight joint line, all joints start and stop together, trapezoidal speed.

With s in [0, 1] along the leg and d = end - start, the path speed may be v = min speed_j / |d_j| and its acceleration
a = min acceleration_j / |d_j|. The leg takes 1/v + v/a when the cruise is reached (v² <= a), else 2 sqrt(1/a).
"""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Floats


@dataclass(frozen=True, kw_only=True)
class LegLaw:
    """The path parameter of one leg over time: accelerate for ``ramp`` s, cruise, brake for ``ramp`` s.

    Attributes:
        duration: s.  ramp: s.  speed: 1/s at the cruise.
    """

    duration: float
    ramp: float
    speed: float

    def share(self, time: Floats) -> Floats:
        """Return s in [0, 1] at times (k,) in s from the start of the leg."""
        if self.duration == 0.0:
            return np.ones_like(time)
        t = np.clip(time, 0.0, self.duration)
        rate = self.speed / self.ramp
        left = self.duration - t
        middle = self.speed * (t - 0.5 * self.ramp)
        rising, falling = t < self.ramp, left < self.ramp
        return np.where(rising, 0.5 * rate * t**2, np.where(falling, 1.0 - 0.5 * rate * left**2, middle))

    def rate(self, time: Floats) -> Floats:
        """Return ds/dt in 1/s at times (k,) in s."""
        if self.duration == 0.0:
            return np.zeros_like(time)
        t = np.clip(time, 0.0, self.duration)
        return self.speed * np.minimum(np.minimum(t, self.duration - t) / self.ramp, 1.0)


def leg_law(start: Floats, end: Floats, speed: Floats, acceleration: Floats) -> LegLaw:
    """Return the fastest law of a leg from start to end (r,) rad within speed and acceleration limits (r,)."""
    change = np.abs(end - start)
    longest, hardest = float((change / speed).max()), float((change / acceleration).max())
    if longest == 0.0:
        return LegLaw(duration=0.0, ramp=0.0, speed=0.0)
    if longest**2 >= hardest:
        ramp = hardest / longest
        return LegLaw(duration=longest + ramp, ramp=ramp, speed=1.0 / longest)
    half = float(np.sqrt(hardest))
    return LegLaw(duration=2.0 * half, ramp=half, speed=1.0 / half)


def leg_time(start: Floats, end: Floats, speed: Floats, acceleration: Floats) -> float:
    """Return the duration in s of ``leg_law``."""
    return leg_law(start, end, speed, acceleration).duration
