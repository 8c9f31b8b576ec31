"""Why points miss, or are worse than they may be, as the counts of a stream show."""

from __future__ import annotations

import math
from collections.abc import Mapping

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.phase_gate import GATE_LEARNED
from eschorty_ros.core.reconstruction.profile_length import EVENTS_WANTED, periods_max
from eschorty_ros.core.reconstruction.settings import Settings

# A larger share of unmodulated columns is a wrong frequency or slow pixels, not things that move.
_UNMODULATED_SHARE = 0.1


def missing_points(
    counts: Mapping[str, int],
    settings: Settings,
    modulation: Modulation,
    columns: int,
    periods_per_profile: int,
) -> list[str]:
    """Return one line for each reason; ``counts`` are the counters of a `Reconstructor`."""
    if removed := _gated(counts, settings, modulation) or _outside_region(counts):
        return [removed]
    few = ""
    if settings.periods_per_profile:
        few = _few_events(counts, modulation, columns, periods_per_profile)
    reasons = (
        _unmodulated(counts, modulation, columns),
        _cut(counts),
        _too_wide(counts, settings),
        few,
        _long_profiles(settings, modulation, periods_per_profile),
    )
    return [reason for reason in reasons if reason]


def _gated(counts: Mapping[str, int], settings: Settings, modulation: Modulation) -> str:
    if settings.phase_gate_us == GATE_LEARNED or 2 * counts["events_gated"] <= counts["events"]:
        return ""
    share = counts["events_gated"] / counts["events"]
    return (
        f"phase_gate_us removes {share:.0%} of the events; set it to 0, or check the "
        f"frequency ({modulation.frequency_hz:g} Hz) and the polarity of the events"
    )


def _unmodulated(counts: Mapping[str, int], modulation: Modulation, columns: int) -> str:
    unmodulated = counts["columns_unmodulated"]
    found = ("points_found", "points_beyond_pole", "points_outside_roi")
    points = sum(counts[name] for name in found)
    share = unmodulated / max(points + unmodulated, 1)
    # Background of dark columns, beside those of a line, has fewer events than these.
    line = counts["events_binned"] - counts["events_unmodulated"]
    dark = 2 * counts["events_unmodulated"] * points < line * unmodulated
    dark &= unmodulated < 10 * points
    # As the laser is switched on, and off, a period has no phase.
    switched = 2 * columns if points else 0
    if share <= _UNMODULATED_SHARE or dark or unmodulated <= switched:
        return ""
    return (
        f"the events of {unmodulated} columns ({share:.0%} of those with enough) do not "
        f"follow the laser at {modulation.frequency_hz:g} Hz and gave no points; check its "
        "frequency, duty cycle and polarity, or choose a lower frequency where pixels are too slow"
    )


def _cut(counts: Mapping[str, int]) -> str:
    cut, points = counts["points_cut"], counts["points_found"]
    if 2 * cut <= points:
        return ""
    return (
        f"the sensor's edge cuts the line in {cut / points:.0%} of the points; "
        "move the surface nearer to the middle of the ranges"
    )


def _too_wide(counts: Mapping[str, int], settings: Settings) -> str:
    if 2 * counts["profiles_too_wide"] <= counts["periods_closed"]:
        return ""
    learned = settings.phase_gate_us == GATE_LEARNED
    return (
        f"the line is more than 1.5 times as wide as line_width_px = {settings.line_width_px:g} "
        f"in {counts['profiles_too_wide']} of {counts['periods_closed']} profiles; focus the "
        "laser, or raise line_width_px"
        + ("" if learned else "; where background makes it wide set phase_gate_us to -1")
    )


def _outside_region(counts: Mapping[str, int]) -> str:
    many = 2 * counts["events_outside_roi"] > counts["events"]
    if not many or counts["columns_too_few_events"] < 10 * counts["points_found"]:
        return ""
    share = counts["events_outside_roi"] / counts["events"]
    return (
        f"{share:.0%} of the events are outside the limits of columns and ranges; widen "
        "column_first, column_last, range_min or range_max"
    )


def _few_events(
    counts: Mapping[str, int], modulation: Modulation, columns: int, periods_per_profile: int
) -> str:
    per_column = counts["events_binned"] / max(counts["periods_closed"] * columns, 1)
    few = counts["columns_too_few_events"]
    if few <= 10 * counts["points_found"] or per_column >= EVENTS_WANTED:
        return ""
    wanted = math.ceil(periods_per_profile * EVENTS_WANTED / max(per_column, 1e-3))
    return (
        f"{few} columns have too few events for a point, {per_column:.2g} per column and profile "
        f"on average; set periods_per_profile to about {min(wanted, periods_max(modulation))}"
    )


def _long_profiles(settings: Settings, modulation: Modulation, periods_per_profile: int) -> str:
    if settings.periods_per_profile != 0 or periods_per_profile <= 1:
        return ""
    return (
        "a column has too few events for a point in one period, or others in the next; "
        f"{periods_per_profile} periods make a profile, "
        f"{modulation.frequency_hz / periods_per_profile:.4g} profiles per second"
    )
