"""Draw docs/architecture.png: who hands what to whom. Run by `make picture`."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

DATA, STAGE, LASER, PLAIN = "#2563a8", "#2e7d4f", "#b3362b", "#555555"
WIDTH, HEIGHT, PITCH = 1.9, 0.86, 2.85

# name: (place along x, y, title, where it lives, colour)
BOXES = {
    "camera": (0, 3.0, "EVK4", "hardware/camera", DATA),
    "decode": (1, 3.0, "bytes to events", "core/evt3", DATA),
    "period": (2, 3.0, "periods", "core/modulation", DATA),
    "line": (3, 3.0, "events to rows", "core/line", DATA),
    "range": (4, 3.0, "rows to ranges", "core/optics", DATA),
    "place": (5, 3.0, "points in space", "core/reconstruction", DATA),
    "cloud": (6, 3.0, "cloud", "core/storage", DATA),
    "stage": (0, 1.5, "DDS220 stage", "hardware/stage", STAGE),
    "clocks": (5, 1.5, "position at\na sensor time", "core/clocks", STAGE),
    "calibration": (3.5, 4.9, "calibration", "core/calibration", PLAIN),
    "scan": (6, 0.0, "scan sequence", "control", PLAIN),
    "supervisor": (5, 0.0, "interlock,\nsupervisor", "control", LASER),
    "guard": (3, 0.0, "guard process", "hardware/laser_guard", LASER),
    "laser": (0, 0.0, "generator", "hardware/laser", LASER),
}
# from, to, text, colour
ARROWS = (
    ("camera", "decode", "EVT3", DATA),
    ("decode", "period", "events", DATA),
    ("period", "line", "a period", DATA),
    ("line", "range", "rows", DATA),
    ("range", "place", "R, X", DATA),
    ("place", "cloud", "x y z", DATA),
    ("stage", "clocks", "encoder readings, trigger pulses", STAGE),
    ("clocks", "place", "s(t)", STAGE),
    ("calibration", "range", "k k' b b'", PLAIN),
    ("line", "calibration", "posts", PLAIN),
    ("scan", "supervisor", "enable", LASER),
    ("supervisor", "guard", "commands, lease", LASER),
    ("guard", "laser", "SCPI; off when the lease ends", LASER),
)


def main() -> None:
    """Write the picture beside this file."""
    figure, axes = plt.subplots(figsize=(15.5, 5.5), dpi=110)
    for place, y, title, where, colour in BOXES.values():
        x = place * PITCH
        axes.add_patch(
            FancyBboxPatch(
                (x, y),
                WIDTH,
                HEIGHT,
                boxstyle="round,pad=0.04,rounding_size=0.1",
                facecolor="white",
                edgecolor=colour,
                linewidth=1.8,
            )
        )
        middle = x + WIDTH / 2
        axes.text(middle, y + 0.56, title, ha="center", va="center", fontsize=10, color=colour)
        axes.text(
            middle, y + 0.13, where, ha="center", va="center", fontsize=6.5, family="monospace"
        )
    for start, end, text, colour in ARROWS:
        (x0, y0), (x1, y1) = _ends(start, end)
        axes.add_patch(
            FancyArrowPatch(
                (x0, y0),
                (x1, y1),
                arrowstyle="-|>",
                mutation_scale=13,
                color=colour,
                linewidth=1.4,
                shrinkA=4,
                shrinkB=4,
            )
        )
        flat = abs(y1 - y0) < 0.1
        # Beside the arrow, on the side that it leaves free.
        left = x1 > x0 and y1 > y0
        axes.text(
            (x0 + x1) / 2 + (0.0 if flat else -0.16 if left else 0.16),
            (y0 + y1) / 2 + (0.12 if flat else 0.0),
            text,
            ha="center" if flat else "right" if left else "left",
            va="bottom" if flat else "center",
            fontsize=7.5,
            color=colour,
        )
    axes.add_patch(
        FancyBboxPatch(
            (PITCH - 0.2, 2.82),
            4 * PITCH + WIDTH + 0.4,
            1.32,
            boxstyle="round,pad=0.02",
            facecolor="none",
            edgecolor=DATA,
            linewidth=0.8,
            linestyle=":",
        )
    )
    axes.text(
        PITCH - 0.15,
        4.22,
        "the same objects offline and behind the nodes",
        fontsize=8,
        color=DATA,
        va="bottom",
    )
    axes.set_xlim(-0.2, 6 * PITCH + WIDTH + 0.2)
    axes.set_ylim(-0.25, 6.0)
    axes.set_axis_off()
    target = Path(__file__).with_suffix(".png")
    figure.savefig(target, bbox_inches="tight", metadata={"Software": ""})
    print(target)


def _ends(start: str, end: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return where the arrow between two boxes begins and ends: side to side, or top to bottom."""
    x0, x1 = BOXES[start][0] * PITCH, BOXES[end][0] * PITCH
    y0, y1 = BOXES[start][1], BOXES[end][1]
    if abs(y0 - y1) < 0.1 or abs(x0 - x1) > 2 * WIDTH:
        right = x1 > x0
        return (
            (x0 + WIDTH if right else x0, y0 + HEIGHT / 2),
            (x1 if right else x1 + WIDTH, y1 + HEIGHT / 2),
        )
    up = y1 > y0
    return (x0 + WIDTH / 2, y0 + HEIGHT if up else y0), (x1 + WIDTH / 2, y1 if up else y1 + HEIGHT)


if __name__ == "__main__":
    main()
