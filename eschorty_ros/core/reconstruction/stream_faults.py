"""What is wrong with a stream of events, as the counts of its decoder and its profiles show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict

from eschorty_ros.core.evt3 import Counters

# Chance gives up to 0.18 of the points of short streams a shift.
_BURST_SHIFT_SHARE = 0.22
_RATE_CONTROL_SHARE = 0.01
_OVER_LIMIT_SHARE = 0.01
# Words that a stream which begins anywhere, or goes on after a gap, may break.
_BROKEN_PER_GAP = 10
_TIME_FAULTS = {
    "decoder_time_high_jumps": "jumps forward {}: events are missing there",
    "decoder_time_high_back": "goes back {}: events have wrong times until it is reached again; "
    "where the camera was started again, make a recording of each start",
}
FEWER_EVENTS = (
    "limit the camera's region of interest (roi), or raise its contrast thresholds (bias_diff_on, "
    "bias_diff_off)"
)
"""What to do where the camera sends too many events."""


def decoder_counts(decoder: Counters) -> Counter[str]:
    """Return the counts of a decoder by the names that a `Reconstructor` gives them."""
    counts = Counter({f"decoder_{name}": int(n) for name, n in asdict(decoder).items()})
    counts["sensor_drop_words"] = decoder.sensor_drop_words
    counts["broken_words"] = decoder.broken_words
    return counts


def is_unreadable(counts: Mapping[str, int]) -> bool:
    """Return whether so many words are broken that what the others say has no meaning."""
    return 4 * counts["broken_words"] > counts["events"]


def stream_faults(counts: Mapping[str, int]) -> list[str]:
    """Return one line for each fault; ``counts`` are the counters of a `Reconstructor`."""
    found: list[str] = []
    if counts["broken_words"] > _BROKEN_PER_GAP * (1 + counts["decoder_gaps"]):
        found.append(
            f"{counts['broken_words']} words of the events are not as EVT3 has them: bytes are "
            "lost or changed; copy the file again, or check the camera's cable"
        )
    if is_unreadable(counts):
        return found
    used = counts["triggers_used"]
    edges = used + counts["triggers_spurious"]
    # A laser that is off sends none.
    bridged = min(counts["edges_bridged"], max(counts["periods_with_points"] - used, 0))
    if max(bridged, edges - used) > used:
        without = f" and {bridged} periods with points begin without one" if bridged else ""
        found.append(
            f"{used} of {edges} edges at the trigger input begin a period{without}; where they are "
            "not the laser's, set trigger_source to what the input is wired to, or to none"
        )
    for name, what in _TIME_FAULTS.items():
        jumps = counts[name] - counts["decoder_gaps"]
        if jumps > 0:
            times = "once" if jumps == 1 else f"{jumps} times"
            found.append(f"the camera's time {what.format(times)}")
    if counts["sensor_drop_words"]:
        found.append(
            f"the sensor reports {counts['sensor_drop_words']} times that its readout lost "
            f"events, which moves rows where one side of the line is lost; {FEWER_EVENTS}"
        )
    before = counts["decoder_erc_events_in"]
    share = 1.0 - counts["decoder_erc_events_out"] / max(before, 1)
    if before and share > _RATE_CONTROL_SHARE:
        found.append(
            f"the camera's event-rate control drops {share:.0%} of the events; {FEWER_EVENTS}"
        )
    over = counts["events_over_column_limit"] / max(counts["events"], 1)
    share = counts["points_burst_shift"] / max(counts["points_followed"], 1)
    if over > _OVER_LIMIT_SHARE:
        # The last events of a profile miss, which the following lines would ascribe to the camera.
        found.append(
            f"column_limit drops {over:.0%} of the events, the last ones of a profile; raise it, "
            "lower periods_per_profile, or let the camera send fewer events"
        )
    elif 2 * counts["points_one_polarity"] > counts["points_followed"]:
        found.append(
            "the line has events of one polarity alone: where it moves, its rows are ahead (ON) or "
            "behind (OFF) by up to its width, and sigma has its displacement per profile only; let "
            "the camera send both (bias_diff_on, bias_diff_off)"
        )
    elif share > _BURST_SHIFT_SHARE:
        found.append(
            f"early and late events of a burst have different rows in {share:.0%} of the "
            "points: the readout loses one side of the line, or the line is asymmetric; rows are "
            f"those of late events; {FEWER_EVENTS}"
        )
    elif 2 * counts["profiles_one_end"] > counts["periods_closed"]:
        found.append(
            "one end of the line stays in the same rows, while the other is the surface's, in "
            f"{counts['profiles_one_end']} of {counts['periods_closed']} profiles: the readout "
            "loses it; rows are wrong, or estimated from the other end with the flag mixed; "
            f"{FEWER_EVENTS}"
        )
    elif 2 * counts["footprints_asymmetric"] > counts["footprints"]:
        found.append(
            "the mean of the line's rows is not in the middle of its ends: the readout loses one "
            f"side, or the line is asymmetric; calibrate with this light, or {FEWER_EVENTS}"
        )
    return found
