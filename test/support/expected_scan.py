"""The accuracy that every scan of a simulated scene must reach."""

from eschorty_ros.core.optics import load_calibration
from eschorty_ros.report import accuracy
from eschorty_ros.simulation.scenes import named


def assert_accurate(points, sweep, scene="steps"):
    """Nearly complete, median error under 0.7 mm, 95th percentile under 2.5 mm."""
    build = load_calibration("config_3")
    measured = accuracy.measure(points, named(scene), build.model(), sweep, build.stage_direction)
    print(measured)
    assert measured.completeness >= 0.98
    assert measured.error_median_mm <= 0.7
    assert measured.error_p95_mm <= 2.5
    return measured
