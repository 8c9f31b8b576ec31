"""Why points miss, or are worse than they may be, as the counts of a stream show."""

from __future__ import annotations

import math
from collections.abc import Mapping

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.phase_gate import GATE_LEARNED
from eschorty_ros.core.reconstruction.profile_length import EVENTS_WANTED, FEW_SHARE, periods_max
from eschorty_ros.core.reconstruction.settings import Settings
from eschorty_ros.core.reconstruction.stream_faults import FEWER_EVENTS, is_unreadable

# A larger share of unmodulated columns is a wrong frequency or slow pixels, not things that move.
_UNMODULATED_SHARE = 0.1
# Share of the events below which 15 % of the points and more are on other light, in recordings of
# three simulators; with more it is 3 % at most.
_LINE_SHARE = 0.1
# Losses for each point from which on points are few.
_LOST_PER_POINT = 10
_LOSSES = {
    "columns_too_few_events": "columns have fewer events than events_min = {0.events_min}; lower "
    "it, or raise periods_per_profile = {0.periods_per_profile}",
    "columns_isolated": "columns have no neighbour within isolation_gate_px = "
    "{0.isolation_gate_px:g}; raise it, or lower isolation_events = {0.isolation_events}",
    "columns_ambiguous": "columns have two equally strong lines; set returns to all",
    "points_beyond_pole": "points are beyond the last range of the calibration; check it",
    "points_outside_roi": "points are outside range_min and range_max; widen them",
    "points_flagged": "points have a flag; set keep to all",
    "points_outside_scan": "points are outside start to stop of the recorded scan; check the "
    "stage's positions",
}
"""Losses after which no point is left, with what to do; ``{0}`` are the settings."""
_WITHOUT_POINT = {"columns_unmodulated", *(name for name in _LOSSES if name.startswith("columns"))}
_FILTERED = "events are removed by noise_filter = {0.noise_filter}; set it to none"


def missing_points(
    counts: Mapping[str, int],
    settings: Settings,
    modulation: Modulation,
    columns: int,
    periods_per_profile: int,
    faulty: bool,
) -> list[str]:
    """Return one line for each reason; ``counts`` are the counters of a `Reconstructor`.

    Columns of a ``faulty`` stream, whose warnings come before, may have lost their events.
    """
    removed = _gated(counts, settings, modulation) or _outside_region(counts)
    if removed := removed or _other_light(counts):
        return [removed]
    few = ""
    if settings.periods_per_profile:
        few = _few_events(counts, modulation, columns, periods_per_profile)
    reasons = (
        _unmodulated(counts, modulation, columns),
        _cut(counts),
        _too_wide(counts, settings),
        few or ("" if faulty else _weak(counts, settings, modulation, periods_per_profile)),
        _long_profiles(counts, settings, modulation, periods_per_profile),
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


def _points_of_any_range(counts: Mapping[str, int]) -> int:
    return sum(
        counts[name] for name in ("points_found", "points_beyond_pole", "points_outside_roi")
    )


def _unmodulated(counts: Mapping[str, int], modulation: Modulation, columns: int) -> str:
    unmodulated, points = counts["columns_unmodulated"], _points_of_any_range(counts)
    share = unmodulated / max(points + unmodulated, 1)
    # Background of dark columns, beside those of a line, has fewer events than these.
    line = counts["events_binned"] - counts["events_unmodulated"]
    dark = 2 * counts["events_unmodulated"] * points < line * unmodulated
    dark &= unmodulated < _LOST_PER_POINT * points
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
    lost = counts["columns_too_few_events"]
    if not many or lost < _LOST_PER_POINT * counts["points_found"]:
        return ""
    share = counts["events_outside_roi"] / counts["events"]
    return (
        f"{share:.0%} of the events are outside the limits of columns and ranges; widen "
        "column_first, column_last, range_min or range_max"
    )


def _other_light(counts: Mapping[str, int]) -> str:
    """Return a line where columns have ten times the events of their points, or more."""
    points, used = counts["points_found"], counts["events_used"]
    unused = counts["events_binned"] - used
    columns = points + sum(n for name, n in counts.items() if name in _WITHOUT_POINT)
    if used >= _LINE_SHARE * counts["events_binned"] or unused * points <= used * columns:
        return ""
    return (
        f"the points have {used / counts['events_binned']:.1%} of the events; the others are of "
        "lamps that flicker, of things that move or noise, and points on them are wrong; darken "
        f"the scene, {FEWER_EVENTS}"
    )


def _few_events(
    counts: Mapping[str, int], modulation: Modulation, columns: int, periods_per_profile: int
) -> str:
    per_column = counts["events_binned"] / max(counts["periods_closed"] * columns, 1)
    few = counts["columns_too_few_events"]
    if few <= _LOST_PER_POINT * counts["points_found"] or per_column >= EVENTS_WANTED:
        return ""
    wanted = math.ceil(periods_per_profile * EVENTS_WANTED / max(per_column, 1e-3))
    return (
        f"{few} columns have too few events for a point, {per_column:.2g} per column and profile "
        f"on average; set periods_per_profile to about {min(wanted, periods_max(modulation))}"
    )


def _weak(
    counts: Mapping[str, int],
    settings: Settings,
    modulation: Modulation,
    periods_per_profile: int,
) -> str:
    weak = counts["columns_weak"]
    columns, most = _points_of_any_range(counts) + weak, periods_max(modulation)
    if weak <= FEW_SHARE * columns:
        return ""
    events = max(counts["events_used"] / columns, 1.0)
    wanted = max(math.ceil(periods_per_profile * EVENTS_WANTED / events), periods_per_profile + 1)
    longer = f"set periods_per_profile to about {min(wanted, most)}, or "
    return (
        f"{weak} columns ({weak / columns:.0%} of those with events at the line's row) have fewer "
        f"than events_min = {settings.events_min} and gave no points; "
        f"{longer if periods_per_profile < most else ''}lower the camera's contrast thresholds "
        "(bias_diff_on, bias_diff_off)"
    )


def _long_profiles(
    counts: Mapping[str, int],
    settings: Settings,
    modulation: Modulation,
    periods_per_profile: int,
) -> str:
    if settings.periods_per_profile != 0 or periods_per_profile <= 1:
        return ""
    events = counts["events_used"] / max(_points_of_any_range(counts), 1)
    enough = math.ceil(periods_per_profile * EVENTS_WANTED / max(events, 1.0))
    shorter = (
        f"; points have {events:.0f} events: where the recording begins in the dark or on a dark "
        f"surface set periods_per_profile to about {enough}"
    )
    return (
        "a column has too few events for a point in one period, or others in the next; "
        f"{periods_per_profile} periods make a profile, "
        f"{modulation.frequency_hz / periods_per_profile:.4g} profiles per second"
        f"{shorter if 2 * enough <= periods_per_profile else ''}"
    )


def without_modulation(events: int, frequency_hz: float) -> str:
    """Return the cause of few points where the laser's modulation is not in the events."""
    if not events:
        return "no events came; look at the camera, its lens cap and the laser"
    return (
        f"hardly any of {events:,} events follow the laser's modulation at {frequency_hz:g} Hz; "
        "look at its frequency, at the focus and at what the line falls on"
    )


def cause_of_few(
    settings: Settings, counters: Mapping[str, int], points: int, dark: str, modulated: bool
) -> str:
    """Return the largest loss where it left few points or none, ``dark`` where there is none.

    It is ``""`` where the reconstructor has a line for it, or points are not few.
    """
    outside = 2 * max(counters["events_gated"], counters["events_outside_roi"])
    if outside > counters["events"] or is_unreadable(counters) or _other_light(counters):
        return ""
    losses = [name for name in _LOSSES if name != "points_flagged" or settings.keep == "good"]
    lost = max(losses, key=lambda name: counters[name])
    if modulated and not points and counters["columns_unmodulated"] > counters[lost]:
        return ""
    if 2 * counters["events_filtered"] > counters["events"]:
        words, count = _FILTERED, counters["events_filtered"]
    else:
        words, count = _LOSSES[lost], counters[lost]
        unused = counters["events_binned"] - counters["events_used"]
        # Background alone leaves columns with few events, too.
        if points and lost in _WITHOUT_POINT and unused < Settings().events_min * count:
            return ""
    if points and count <= _LOST_PER_POINT * points:
        return ""
    return f"{count:,} {words.format(settings)}" if modulated and count else dark
