import numpy as np
import pytest

from netdesign.calibrate import calibrate_noise, calibrate_study, write_calibration
from netdesign.files.noise import read_corner_noise
from netdesign.imaging.photograph import Shoot
from tests.runs import STUDY, write_inputs
from tests.scenes import CAMERA, box_scene


def test_calibration_on_a_small_grid(tmp_path):
    shoot = Shoot(seed=2, renderer="reference")
    found = calibrate_noise(CAMERA, shoot, sides_px=(30.0, 50.0), incidences_deg=(30.0,), replicates=4)
    # Two cells of 12 tags x 8 x 3 degrees of freedom: sigma to some 6 %; the closed form scatters by 4 %.
    assert found.noise.k == pytest.approx(read_corner_noise(None, "tag36h11").k, rel=0.2)
    assert 0 <= found.noise.floor_px < 0.006
    for cell in found.cells:
        assert cell.tags + cell.rejected + cell.missed >= 48
        assert cell.tags >= 44
        assert abs(cell.shrink_px) < 0.003
        assert 0.7 < cell.nees < 1.4
    np.testing.assert_allclose(found.ratios, 1.0, atol=0.2)
    write_calibration(tmp_path / "noise.json", found, CAMERA, shoot)
    assert read_corner_noise(tmp_path / "noise.json", "tag36h11") == found.noise


def test_a_place_that_cannot_be_written_is_named_before_anything_is_measured(tmp_path, monkeypatch):
    def measured(*_, **__):
        raise AssertionError("measured")

    write_inputs(tmp_path / "run", box_scene(spacing=0.06), STUDY)
    monkeypatch.setattr("netdesign.calibrate.calibrate_noise", measured)
    with pytest.raises(NotADirectoryError):
        calibrate_study(tmp_path / "run/study.toml", tmp_path / "run/study.toml/noise.json", workers=1)
