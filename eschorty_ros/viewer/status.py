"""The text beside the picture: laser, progress and losses."""

from __future__ import annotations

from dataclasses import dataclass, field

_OUTPUTS = ("off", "ON", "unknown")


@dataclass
class Status:
    """State that the instrument reports; a value that is not known is NaN or empty."""

    laser: str = "no report"
    reason: str = ""
    phase: str = ""
    progress: float = 0.0
    scan_id: str = ""
    message: str = ""
    events_per_second: float = float("nan")
    counts: dict[str, int] = field(default_factory=dict)

    def markdown(self, received: int, stride: int) -> str:
        """Return the text of the page."""
        rows = [
            ("laser", f"**{self.laser}** {self.reason}"),
            ("scan", f"{self.phase} {self.progress:.0%}" if self.phase
             else self.scan_id or "none"),
            ("events/s", "no report" if self.events_per_second != self.events_per_second
             else f"{self.events_per_second:,.0f}"),
            *((name.replace("_", " "), f"{count:,}") for name, count in self.counts.items()),
            ("here", points_text(received, stride)),
        ]  # fmt: skip
        lines = ["| | |", "| --- | --- |"]
        lines += [f"| {name} | {_plain(text)} |" for name, text in rows]
        return "\n".join(lines) + (f"\n\n{_plain(self.message)}" if self.message else "")


def points_text(received: int, stride: int) -> str:
    """Return how many points there are and how many are drawn."""
    drawn = "all" if stride == 1 else f"1 in {stride:,}"
    return f"{received:,} points, {drawn} drawn"


def laser_text(output: int, armed: bool) -> str:
    """Return the state of the output that a ``LaserState`` reports."""
    known = _OUTPUTS[output] if 0 <= output < len(_OUTPUTS) else _OUTPUTS[-1]
    return known + (", armed" if armed and output == 0 else "")


def _plain(text: str) -> str:
    """Return text that breaks no table and holds no markup of its own."""
    return text.translate(str.maketrans("|<>[\n", "/()( "))
