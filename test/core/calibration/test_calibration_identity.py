"""A calibration of another sensor, window or build is refused by name."""

import pytest

from eschorty_ros.core.base.errors import CalibrationError
from eschorty_ros.core.calibration import refuse_other_instrument
from eschorty_ros.core.optics import Calibration, load_calibration, save_calibration

ACTIVE = load_calibration("config_3")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": "config_1"}, r"name \(build\) is 'config_1' and the instrument's 'config_3'"),
        ({"columns": 640}, "columns .* 640 .* 1280"),
        ({"rows": 480}, "rows .* 480 .* 720"),
        ({"pixel_um": 15.0}, "pixel_um .* 15.0 .* 4.86"),
        ({"roi_px": (0, 100, 1280, 400)}, r"roi_px .* \(0, 100, 1280, 400\) .* None"),
    ],
)
def test_what_differs_is_named(change, words):
    with pytest.raises(CalibrationError, match=words):
        refuse_other_instrument(ACTIVE.model_copy(update=change), ACTIVE)


def test_another_fit_of_the_same_instrument_passes():
    refuse_other_instrument(load_calibration("config_3_as_built"), ACTIVE)


def test_the_window_survives_the_file(tmp_path):
    seen = ACTIVE.model_copy(update={"roi_px": (10, 100, 1200, 400)})
    save_calibration(seen, tmp_path / "c.yaml")
    assert load_calibration(tmp_path / "c.yaml") == seen


@pytest.mark.parametrize("window", [(0, 0, 1281, 720), (-1, 0, 10, 10), (0, 700, 10, 30),
                                    (0, 0, 0, 10)])  # fmt: skip
def test_a_window_off_the_sensor_is_refused(window):
    data = ACTIVE.model_dump() | {"roi_px": window}
    with pytest.raises(ValueError, match="roi_px"):
        Calibration.model_validate(data)
