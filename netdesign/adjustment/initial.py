"""Approximate values from tags alone: one square tag gives the camera's pose, up to a two-fold ambiguity.

Known part: of all poses that an image's tags propose, the one that explains all its tags best. Unknown part: a spanning
tree from the tag that most images see; the next node is the one with the most placed neighbours, and of the poses
that those propose, again the one that explains all sightings best. That resolves the ambiguity wherever a second
sighting exists. Errors of some ten millimetres are normal and well inside the adjustment's reach.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from netdesign.errors import InfeasibleError
from netdesign.model.arrays import Bools, Floats, frozen
from netdesign.model.frames import inverse, transform
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.connectivity import listed, named


@dataclass(frozen=True, kw_only=True)
class TagSighting:
    """One tag in one image.

    Attributes:
        image, tag: indices.  corners_px: (4, 2), order TL, TR, BR, BL.
        candidates: tag_from_cam (4, 4) with rms in px, best first (one or two).
    """

    image: int
    tag: int
    corners_px: Floats
    candidates: tuple[tuple[Floats, float], ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "corners_px", frozen("corners_px", self.corners_px, (4, 2)))

    @property
    def confidence(self) -> float:
        """How much worse the second pose explains the tag; at most 100."""
        if len(self.candidates) < 2:
            return 100.0
        return min(self.candidates[1][1] / max(self.candidates[0][1], 1e-6), 100.0)


def square(size_m: float) -> Floats:
    """Return the corners (4, 3) of a tag in its own frame: x right, y up, z out of its face."""
    half = 0.5 * size_m
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])


def _misfit(sighting: TagSighting, world_from_cam: Floats, world_from_tag: Floats, size_m: float, k: Floats) -> float:
    """Return the rms distance in px of a sighting from its projection, 1000 px for a tag behind the camera."""
    xy, depth = project(world_from_cam, transform(world_from_tag, square(size_m)), k)
    if not (depth > 0).all():
        return 1000.0
    return min(float(np.sqrt(((xy - sighting.corners_px) ** 2).sum(axis=1).mean())), 1000.0)


def poses_on_known_tags(
    sightings: Sequence[TagSighting], world_from_tag: Floats, size_m: float, intrinsics: Floats, images: int
) -> tuple[Floats, Bools]:
    """Return world_from_cam (n, 4, 4) and which images have one (n,).

    Args:
        world_from_tag: (g, 4, 4) m, nominal.  size_m: edge of the tags.  images: n.
    """
    poses, placed = np.tile(np.eye(4), (images, 1, 1)), np.zeros(images, dtype=np.bool_)
    for image in range(images):
        seen = [sighting for sighting in sightings if sighting.image == image]
        best = np.inf
        for proposer in seen:
            for tag_from_cam, _ in proposer.candidates:
                pose = world_from_tag[proposer.tag] @ tag_from_cam
                # The median of the misfits: nominal coordinates may be wrong for some tags.
                misfit = float(np.median([_misfit(s, pose, world_from_tag[s.tag], size_m, intrinsics) for s in seen]))
                if misfit < best:
                    best, poses[image], placed[image] = misfit, pose, True
    return poses, placed


def poses_and_tags(
    sightings: Sequence[TagSighting],
    size_m: float,
    intrinsics: Floats,
    image_names: Sequence[str],
    tag_names: Sequence[str],
) -> tuple[Floats, Floats]:
    """Return world_from_cam (n, 4, 4) and world_from_tag (g, 4, 4); the world is the frame of the tag seen most often.

    Raises:
        InfeasibleError: tags or images that no chain of common tags ties to the others.
    """
    images, tags = len(image_names), len(tag_names)
    by_image: list[list[TagSighting]] = [[] for _ in range(images)]
    by_tag: list[list[TagSighting]] = [[] for _ in range(tags)]
    for sighting in sightings:
        by_image[sighting.image].append(sighting)
        by_tag[sighting.tag].append(sighting)
    cameras, world_from_tag = np.tile(np.eye(4), (images, 1, 1)), np.tile(np.eye(4), (tags, 1, 1))
    camera_placed, tag_placed = np.zeros(images, dtype=np.bool_), np.zeros(tags, dtype=np.bool_)
    tag_placed[int(np.argmax([len(seen) for seen in by_tag]))] = True
    while not (camera_placed.all() and tag_placed.all()):
        # (placed neighbours, confidence of the best of them, kind, index); ties go to the lowest index.
        choices = [
            (sum(tag_placed[s.tag] for s in by_image[i]), _best([s for s in by_image[i] if tag_placed[s.tag]]), 0, -i)
            for i in np.flatnonzero(~camera_placed).tolist()
        ]
        choices += [
            (
                sum(camera_placed[s.image] for s in by_tag[g]),
                _best([s for s in by_tag[g] if camera_placed[s.image]]),
                1,
                -g,
            )
            for g in np.flatnonzero(~tag_placed).tolist()
        ]
        neighbours, _, kind, negative = max(choices)
        if neighbours == 0:
            lost = [f"image {name}" for name in named(image_names, ~camera_placed)]
            lost += [f"tag {name}" for name in named(tag_names, ~tag_placed)]
            raise InfeasibleError(f"no chain of common tags ties these to the others: {listed(lost)}")
        index = -negative
        if kind == 0:
            seen = [s for s in by_image[index] if tag_placed[s.tag]]
            proposals = [world_from_tag[s.tag] @ candidate for s in seen for candidate, _ in s.candidates]
            misfits = [
                np.median([_misfit(s, pose, world_from_tag[s.tag], size_m, intrinsics) for s in seen])
                for pose in proposals
            ]
            cameras[index], camera_placed[index] = proposals[int(np.argmin(misfits))], True
        else:
            seen = [s for s in by_tag[index] if camera_placed[s.image]]
            proposals = [cameras[s.image] @ inverse(candidate) for s in seen for candidate, _ in s.candidates]
            misfits = [
                np.median([_misfit(s, cameras[s.image], pose, size_m, intrinsics) for s in seen]) for pose in proposals
            ]
            world_from_tag[index], tag_placed[index] = proposals[int(np.argmin(misfits))], True
    return cameras, world_from_tag


def _best(seen: Sequence[TagSighting]) -> float:
    return max((s.confidence for s in seen), default=0.0)
