"""The line's thickness on edges of a scene."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from eschorty_ros.core.clocks import MotionPlan
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.simulation.scenes import Plane, Sphere, named
from eschorty_ros.simulation.world import World, line_on_scene
from eschorty_ros.simulation.world.off_sheet import off_sheet

SEED = 2
CALIBRATION = replace(load_calibration("config_3"), columns=48, principal_column=None)
MODEL = CALIBRATION.model()
HALF_ROWS = 12.0


@dataclass(frozen=True)
class Edge:
    """Two half planes that meet at one stage position."""

    at_mm: float = 50.0
    ranges_mm: tuple[float, float] = (1320.0, 1320.0)
    reflectances: tuple[float, float] = (1.0, 1.0)

    def _choose(self, stage_mm, columns, values) -> np.ndarray:
        beyond = np.atleast_1d(stage_mm) >= self.at_mm
        return np.repeat(np.where(beyond, values[1], values[0])[:, np.newaxis], np.size(columns), 1)

    def range_mm(self, stage_mm, columns, model) -> np.ndarray:
        return self._choose(stage_mm, columns, self.ranges_mm)

    def reflectance(self, stage_mm, columns, model) -> np.ndarray:
        return self._choose(stage_mm, columns, self.reflectances)


def rows_seen(scene) -> np.ndarray:
    """Rows of all events of a line that rests at 50 mm."""
    print(f"seed {SEED}")
    world = World(scene, CALIBRATION, seed=SEED, background_hz=0.0)
    world.set_laser(0, True, Modulation(70.0, on_edge_us=0))
    world.set_stage(MotionPlan(0, 50.0))
    return Decoder(48, 720).decode(world.advance(200_000)).y


@pytest.mark.parametrize("ahead_mm", [-1.5, -0.3, 0.4, 2.0])
def test_a_reflectance_edge_lies_where_the_geometry_puts_it(ahead_mm: float) -> None:
    scene = Edge(50.0, reflectances=(0.3, 1.0))
    seen = line_on_scene(scene, MODEL, 50.0 - ahead_mm, HALF_ROWS)
    row = float(MODEL.row(1320.0))
    assert seen.split.tolist() == list(range(48))
    border = row - ahead_mm * float(MODEL.rows_per_mm_off_sheet(1320.0))
    bright = seen.patch_reflectance == 1.0
    # Bright is what lies ahead, and it appears at the lower rows.
    assert np.allclose(seen.high_row[bright], border, atol=0.25)
    assert np.isneginf(seen.low_row[bright]).all()
    assert np.allclose(seen.low_row[~bright], border, atol=0.25)
    assert np.isposinf(seen.high_row[~bright]).all()
    assert np.allclose(seen.patch_row, row)


def test_smooth_surfaces_have_one_patch() -> None:
    for scene in (Plane(), named("tilted"), Plane(1320.0, 1.5, 0.5)):
        for stage_mm in (0.0, 33.3, 100.0):
            seen = line_on_scene(scene, MODEL, stage_mm, HALF_ROWS)
            assert seen.split.size == 0
            here = scene.range_mm([stage_mm], np.arange(48), MODEL)[0]
            assert np.array_equal(seen.row, MODEL.row(here))
    over_the_top = line_on_scene(Sphere(1320.0, 50.0), MODEL, 50.0, HALF_ROWS)
    assert over_the_top.split.size == 0


@pytest.mark.parametrize("slope", [-2.0, 0.5, 3.0])
def test_a_slope_along_the_stage_narrows_or_widens_the_line(slope: float) -> None:
    """A beam's ray beside the sheet meets the slope elsewhere: both move its image."""
    scene, beside_mm = Plane(1320.0, slope), 0.1
    seen = line_on_scene(scene, MODEL, 0.0, HALF_ROWS)
    across = off_sheet(CALIBRATION, np.array([1320.0]), np.array([24]), beside_mm).row
    on_slope = off_sheet(
        CALIBRATION, np.array([1320.0 + slope * beside_mm]), np.array([24]), beside_mm
    ).row
    middle = float(MODEL.row(1320.0, 24))
    expected = np.abs((on_slope - middle) / (across - middle))
    assert seen.thickness == pytest.approx(np.full(48, expected), rel=0.01)


def test_the_end_of_a_scene_cuts_the_line() -> None:
    scene = Edge(50.0, ranges_mm=(1320.0, np.nan))
    row = float(MODEL.row(1320.0))
    per_mm = float(MODEL.rows_per_mm_off_sheet(1320.0))
    inside = line_on_scene(scene, MODEL, 49.0, HALF_ROWS)
    assert np.allclose(inside.low_row[:, 0], row - per_mm, atol=0.25)
    assert not inside.patch_reflectance[:, 1].any()
    outside = line_on_scene(scene, MODEL, 51.0, HALF_ROWS)
    assert np.isnan(outside.row).all()
    assert np.allclose(outside.patch_row[:, 1], row)
    assert np.allclose(outside.low_row[:, 1], row + per_mm, atol=0.25)


def test_a_step_from_dark_to_bright_shifts_the_line_and_mirrors() -> None:
    true_row = float(MODEL.row(1320.0))
    dark_to_bright = rows_seen(Edge(50.0, reflectances=(0.04, 1.0))).mean() - true_row
    bright_to_dark = rows_seen(Edge(50.0, reflectances=(1.0, 0.04))).mean() - true_row
    # Bright ahead, towards +y, appears at the lower rows.
    assert -4.5 <= dark_to_bright <= -3.0
    assert bright_to_dark == pytest.approx(-dark_to_bright, abs=0.4)


def test_a_depth_step_lights_both_levels() -> None:
    y = rows_seen(Edge(50.0, ranges_mm=(1320.0, 1420.0)))
    near, far = (float(MODEL.row(r)) for r in (1320.0, 1420.0))
    # Each shows half of its line: the near one above its centre, the far one below.
    at_near, at_far = y[np.abs(y - near) < 15], y[np.abs(y - far) < 15]
    assert at_near.size + at_far.size > 0.999 * y.size
    assert at_near.size == pytest.approx(at_far.size, rel=0.15)
    assert np.mean(at_near) - near == pytest.approx(5.2, abs=0.8)
    assert np.mean(at_far) - far == pytest.approx(-5.2, abs=0.8)
