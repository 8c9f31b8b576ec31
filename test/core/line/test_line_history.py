"""Sigma of a line that moves: rows of ON and OFF events that disagree show what it is off by."""

import numpy as np
import pytest
from independent_pixels import Camera, stream, wavy
from reconstructing import reconstruct

AHEAD_PX = 3.0


def uneven_line(step_px: float, off_events: int):
    """Return a line that moves by ``step_px`` per period, and whose ON events are ahead of it."""
    camera = Camera(periods=24, events_max=1)

    def row(k, column):
        return wavy(0, column) + step_px * k

    t, x, y, p = camera.line(row)
    y = y + np.where(p == 1, AHEAD_PX, 0.0).astype(int)
    copies = np.where(p == 1, 1, off_events)
    return stream(tuple(np.repeat(values, copies) for values in (t, x, y, p)))


def late_sigma_px(data: bytes) -> float:
    found, _ = reconstruct(data)
    return float(np.median(found.sigma_row[found.period > 12]))


@pytest.mark.parametrize("step_px", [2.0, -2.0])
def test_sigma_of_a_moving_line_holds_what_uneven_polarities_disagree_by(step_px):
    off_events = 3
    disagree_px = (off_events - 1) / (off_events + 1) / 2 * AHEAD_PX
    sigma_px = late_sigma_px(uneven_line(step_px, off_events))
    print(f"sigma {sigma_px:.2f} px, rows disagree by {disagree_px:.2f} px")
    assert disagree_px < sigma_px < 1.2 * disagree_px


@pytest.mark.parametrize(("step_px", "off_events"), [(0.0, 3), (2.0, 1)])
def test_a_line_at_rest_and_even_polarities_have_no_such_sigma(step_px, off_events):
    sigma_px = late_sigma_px(uneven_line(step_px, off_events))
    print(f"sigma {sigma_px:.2f} px")
    assert sigma_px < 0.2
