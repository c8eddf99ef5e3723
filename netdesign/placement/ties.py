"""Images that tie a network together: a bundle adjustment needs common object points, a set cover does not.

Two groups of images without a common tag are tied by two images, each of which sees tags of both: one alone leaves the
scale of one group against the other open.
"""

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.photogrammetry.connectivity import components

PER_TIE = 2


def tying_stations(sees: Bools, directions: Floats, connectors: Bools, room: int) -> Ints:
    """Return indices of connectors that tie as many groups of a network's images together as ``room`` images can.

    Args:
        sees: (n, g) the tags that each image sees; each tag is seen.  connectors: (c, g) those of stations that may be
            added.  directions: (c, 3) unit vectors of theirs, for the two images of a tie to differ.
    """
    chosen: list[int] = []
    while room - len(chosen) >= PER_TIE:
        group = components(np.concatenate([sees, connectors[chosen]]))[1]
        names, tags_of = np.unique(group, return_inverse=True)
        if len(names) < 2:
            break
        # (c, groups): how many tags of each group a connector sees. It ties the two of which it sees most.
        counts = np.stack([connectors[:, tags_of == place].sum(axis=1) for place in range(len(names))], axis=1)
        order = np.argsort(-counts, axis=1, kind="stable")
        weaker = np.take_along_axis(counts, order[:, 1:2], axis=1)[:, 0]
        if not weaker.any():
            break
        first = int(np.lexsort((-counts.sum(axis=1), -weaker))[0])
        same = np.minimum(counts[:, order[first, 0]], counts[:, order[first, 1]]) > 0
        same[first] = False
        # Far apart, but not at the price of seeing fewer tags.
        apart = np.linalg.norm(directions - directions[first], axis=1) * np.sqrt(np.where(same, weaker, 0))
        second = int(np.argmax(np.where(same, apart, -1.0)))
        chosen += [first, second] if same.any() else [first]
        if not same.any():
            connectors = connectors & (np.arange(len(connectors)) != first)[:, None]
    return np.array(chosen, dtype=np.int64)
