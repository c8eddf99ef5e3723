"""What a network does not determine, in words: the images, points and interior parameters that cause it.

Two kinds of statement: complaints (something is open besides the datum: no number may be printed) and flags (the
network holds together, but barely).
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.photogrammetry.normals import CameraSide

MIN_COMMON_POINTS = 8  # points, each seen in 3 images, that must tie an image to the others


def listed(names: Sequence[str], most: int = 6) -> str:
    """Return the first names, comma separated, and how many more there are."""
    text = ", ".join(names[:most])
    return text if len(names) <= most else f"{text} and {len(names) - most} more"


def named(names: Sequence[str], where: Bools | Ints) -> list[str]:
    """Return the names chosen by a mask or by indices."""
    index = np.flatnonzero(where) if where.dtype == np.bool_ else where
    return [names[i] for i in index.tolist()]


def components(visible: Bools) -> tuple[Ints, Ints]:
    """Return the block number of every image (n,) and point (m,): blocks have no common point."""
    images, points = visible.shape
    image, point = np.nonzero(visible)
    graph = coo_array((np.ones(len(image)), (image, images + point)), shape=(images + points, images + points))
    _, label = connected_components(graph, directed=False)
    return label[:images].astype(np.int64), label[images:].astype(np.int64)


def loose_images(sees: Bools) -> int:
    """Return how many images that see something share no tag with the first such, not even by way of others.

    Args:
        sees: (n, g) the tags that each image sees.
    """
    used = sees[sees.any(axis=1)]
    label, _ = components(used)
    return int((label != label[:1]).sum())


def structure_complaints(
    visible: Bools, image_names: Sequence[str], point_names: Sequence[str], known: Bools | None = None
) -> tuple[str, ...]:
    """Return what counting alone tells: unseen points, points seen once, images that see too little, loose blocks.

    Args:
        visible: (n, m).  known: (m,) points with known coordinates (control), which need no second ray and tie
            blocks together.
    """
    known = np.zeros(visible.shape[1], dtype=np.bool_) if known is None else known
    rays, seen = visible.sum(axis=0), visible.sum(axis=1)
    complaints = []
    for count, text in ((0, "seen in no image"), (1, "seen in one image only: a point needs two rays")):
        found = named(point_names, (rays == count) & ~known)
        if found:
            complaints.append(f"{len(found)} point(s) {text}: {listed(found)}")
    for i in np.flatnonzero(seen < 3).tolist():
        complaints.append(f"image {image_names[i]} sees {seen[i]} point(s): a pose needs at least 3")
    label, _ = components(np.hstack([visible, visible[:, known].any(axis=1, keepdims=True)]))
    used = seen >= 3
    if known.sum() < 3 and len(np.unique(label[used])) > 1:
        groups = [named(image_names, (label == k) & used) for k in np.unique(label[used])]
        complaints.append(
            f"{len(groups)} blocks of images have no common point: "
            + " | ".join(listed(group) for group in sorted(groups, key=lambda g: (-len(g), g)))
        )
    return tuple(complaints)


def numeric_complaints(
    camera_side: CameraSide,
    images: int,
    image_names: Sequence[str],
    parameter_names: Sequence[str],
) -> tuple[str, ...]:
    """Return which poses and interior parameters take part in what the normal equations leave open.

    Args:
        images: number of poses that lead the camera-side unknowns.  parameter_names: those that follow them.
    """
    open_ = camera_side.null_vectors
    if open_.shape[1] == 0:
        return ()
    part = np.linalg.norm(open_, axis=1)
    pose_part = np.asarray(np.linalg.norm(part[: 6 * images].reshape(images, 6), axis=1))
    parameter_part = part[6 * images : 6 * images + len(parameter_names)]
    limit = 0.1 * max(float(part.max()), 1e-300)
    strongest = np.argsort(-parameter_part, kind="stable")
    names = named(parameter_names, strongest[parameter_part[strongest] > limit])
    text = f"{open_.shape[1]} unknown(s) besides the datum are not determined"
    if names:
        return (f"{text}; interior orientation: {listed(names)}",)
    strongest = np.argsort(-pose_part, kind="stable")
    return (f"{text}; poses of images {listed(named(image_names, strongest[pose_part[strongest] > limit]))}",)


def tie_flags(visible: Bools, image_names: Sequence[str]) -> tuple[str, ...]:
    """Return groups of images that hang on the rest by fewer than MIN_COMMON_POINTS points seen in three images.

    Points seen in two images carry no scale from one block to the next, so they do not count as ties.
    """
    if len(visible) < 3:
        return ()
    strong = visible[:, visible.sum(axis=0) >= 3].astype(np.float32)
    common = strong @ strong.T
    _, label = connected_components(common >= MIN_COMMON_POINTS, directed=False)
    if label.max(initial=0) == 0:
        return ()
    sizes = np.bincount(label)
    main = int(np.argmax(sizes))
    flags = []
    for k in np.flatnonzero(np.arange(len(sizes)) != main):
        group = label == k
        points = int(((strong[group].sum(axis=0) > 0) & (strong[~group].sum(axis=0) > 0)).sum())
        flags.append(
            f"images {listed(named(image_names, group))} hang on the rest by "
            f"{points} point(s) seen in three images, in no pair by {MIN_COMMON_POINTS}"
        )
    return tuple(flags)


def weakest_part(
    spread: Floats, pose_variance: Floats, image_names: Sequence[str], point_names: Sequence[str]
) -> tuple[str, str]:
    """Return the names of the images and of the points that carry most of the variance due to the poses.

    Args:
        spread: (m,) variance that the unknown poses add to each point.  pose_variance: (n,) that each image causes.
    """
    images = np.argsort(-pose_variance, kind="stable")
    share = np.cumsum(pose_variance[images]) / max(float(pose_variance.sum()), 1e-300)
    images = images[: int(np.searchsorted(share, 0.5)) + 1]
    worst = np.argsort(-spread, kind="stable")[: max(1, len(spread) // 10)]
    return listed(named(image_names, np.sort(images)), 4), listed(named(point_names, worst), 4)
