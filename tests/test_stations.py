"""Stations read back from poses: the azimuth as the study counts it."""

import numpy as np
import pytest

from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.stations import ViewingSphere


def sphere(azimuth_deg):
    low, high = np.radians(azimuth_deg)
    centre = np.array([0.3, -2.0, 500.0])
    return ViewingSphere(
        centre=centre, radius=0.7, azimuth=(low, high), elevation=(-np.pi / 2, np.pi / 2), roll=0.0, max_images=4
    )


@pytest.mark.parametrize("azimuth_deg", [(90, 270), (300, 360), (-250, -110), (-180, 180), (0, 360), (-20, 20)])
def test_the_azimuth_of_a_station_lies_in_the_study_s_range(azimuth_deg):
    here = sphere(azimuth_deg)
    asked = np.radians([[a, b] for a in np.linspace(*azimuth_deg, 9) for b in (-89.0, 0.0, 40.0)])
    found, radius = here.placed(here.cameras(asked))
    np.testing.assert_allclose(radius, 0.7, rtol=1e-12)
    np.testing.assert_allclose(np.cos(found[:, 0] - asked[:, 0]), 1.0, atol=1e-12)
    np.testing.assert_allclose(found[:, 1], asked[:, 1], atol=1e-9)
    assert (found[:, 0] >= here.azimuth[0]).all()
    assert (found[:, 0] <= here.azimuth[1]).all()


def test_the_azimuth_straight_above_lies_in_the_range_too():
    here = sphere((90, 270))
    found, _ = here.placed(here.cameras(np.radians([[200.0, 90.0], [123.0, -90.0]])))
    np.testing.assert_allclose(np.degrees(found), [[90.0, 90.0], [90.0, -90.0]], atol=1e-6)


def test_stations_beyond_the_range_keep_their_azimuth():
    here = sphere((90, 270))
    directions = sphere_directions(np.radians([[-45.0, 10.0], [45.0, 10.0]]))
    found, _ = here.placed(look_at(here.centre + directions, here.centre))
    np.testing.assert_allclose(np.degrees(found), [[-45.0, 10.0], [45.0, 10.0]], atol=1e-9)
