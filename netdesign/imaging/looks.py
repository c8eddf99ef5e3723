"""How bright things are in a picture."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """Linear light levels, full scale 1.

    Attributes:
        black, white: of a tag and its quiet zone.
        face: of a part's face that looks at the light, darker by up to ``relief`` when it looks away: only for the eye.
        mottle: random part of every face's level, plus or minus: texture for finely meshed parts.
        light: (3,) direction to that light, world frame.
    """

    black: float = 20 / 255
    white: float = 235 / 255
    face: float = 0.72
    relief: float = 0.22
    mottle: float = 0.0
    background: float = 0.25
    light: tuple[float, float, float] = (0.45, 0.25, 0.86)
