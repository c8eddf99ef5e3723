from dataclasses import replace

import numpy as np
import pytest

from netdesign.errors import InfeasibleError
from netdesign.photogrammetry.visibility import REASONS
from netdesign.placement.coverage import coverage, least_images
from tests.scenes import LIMITS, box_scene, plate_scene, sphere
from tests.test_bound import make_task


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_shares_reasons_and_counts_agree():
    found = coverage(make_task(box_scene(spacing=0.1)))
    assert found.weights.sum() == pytest.approx(1)
    assert sum(found.refusals.values()) == found.reason.size
    assert found.refusals["seen"] == (found.reason == 0).sum()
    np.testing.assert_allclose(found.share, found.weights @ (found.reason == 0))
    assert (found.share > 0.1).all()
    assert set(found.main_reason) == {"incidence"}
    assert found.obstacles == ()
    found.demand_feasible()
    assert 3 <= found.least_images <= 8


def test_the_share_of_a_tag_that_looks_up_is_a_spherical_cap():
    """Far away and with no other limit, incidence alone decides: the cap of 65 degrees about the normal."""
    limits = replace(LIMITS, min_tag_px=0, min_points_per_image=4)
    found = coverage(make_task(plate_scene(side=1), stations=sphere(radius=50, elevation=(0, 90)), limits=limits))
    assert found.share[0] == pytest.approx(1 - np.cos(np.radians(65)), abs=0.02)
    assert found.least_images == LIMITS.min_rays


def test_tags_that_nobody_sees_are_named_with_the_reason():
    scene = box_scene(spacing=0.1)
    limits = replace(LIMITS, min_tag_px=400)
    found = coverage(make_task(scene, limits=limits))
    assert found.never.all()
    assert "size" in found.obstacles[0]
    with pytest.raises(InfeasibleError, match=f"{len(scene.targets.ids)} of {len(scene.targets.ids)} tags"):
        found.demand_feasible()
    high = coverage(make_task(scene, stations=sphere(elevation=(75, 90))))
    sides = scene.targets.normals[:, 2] == 0
    np.testing.assert_array_equal(high.never, sides)
    assert {high.main_reason[g] for g in np.flatnonzero(sides)} == {"incidence"}
    assert REASONS[2] in high.obstacles[0]


def test_two_sides_that_no_viewpoint_sees_together_are_no_network():
    """A sheet with tags on both faces: front and back images have nothing in common, whatever is chosen."""
    front = plate_scene(side=3, spacing=0.06)
    part, targets = front.part, front.targets
    both = replace(
        targets, ids=np.concatenate([targets.ids, targets.ids + 100]),
        centres=np.concatenate([targets.centres, targets.centres - [0, 0, np.ptp(part.vertices[:, 2])]]),
        normals=np.concatenate([targets.normals, -targets.normals]),
        x_axes=np.concatenate([targets.x_axes, targets.x_axes]),
    )  # fmt: skip
    around = sphere(elevation=(-90, 90))
    found = coverage(make_task(replace(front, targets=both), stations=around))
    assert [len(group) for group in found.groups] == [9, 9]
    assert found.groups[1][0] == 100
    with pytest.raises(InfeasibleError, match="the tags fall into 2 groups of which no viewpoint sees two"):
        found.demand_feasible()
    assert coverage(make_task(front)).obstacles == ()


def test_a_single_tag_is_no_image():
    found = coverage(make_task(plate_scene(side=1)))
    assert found.lonely.all()
    assert not found.never.any()
    assert found.admissible == 0
    with pytest.raises(InfeasibleError, match="min_points_per_image"):
        found.demand_feasible()


def test_too_few_images_are_refused():
    found = coverage(make_task(box_scene(spacing=0.1), stations=sphere(max_images=3)))
    assert found.least_images > 3
    with pytest.raises(InfeasibleError, match="max_images"):
        found.demand_feasible()


def test_the_least_number_of_images_is_a_lower_bound_and_sharp_where_the_cover_is_disjoint():
    assert least_images(np.eye(5, dtype=bool), 3) == 15
    assert least_images(np.ones((4, 7), dtype=bool), 2) == 2
    # Three tags, every row sees two of them: 1.5 rows' worth, rounded up.
    assert least_images(~np.eye(3, dtype=bool), 1) == 2
    rng = np.random.default_rng(0)
    for _ in range(5):
        rows = rng.random((9, 6)) < 0.4
        rows[0] = True
        rows[0, rng.integers(6)] = False
        rows[1] = ~rows[0]
        best = min(
            bin(chosen).count("1") for chosen in range(1, 1 << 9)
             if rows[[i for i in range(9) if chosen >> i & 1]].any(axis=0).all()
        )  # fmt: skip
        assert least_images(rows, 1) <= best
