"""Warnings about the light of a live stream that is on or was last."""

from __future__ import annotations

from eschorty_ros.core.reconstruction import Reconstructor, Settings

# Share by which a frequency differs from the same one read back.
_OTHER_FREQUENCY = 1e-3


class LightWarnings:
    """Warnings about a stream since the laser was switched on, or since the scan began.

    After the light has ended they are those of its last period: those without light have few
    events, which do not follow the laser.
    """

    def __init__(self) -> None:
        self._counts_before: dict[str, int] = {}
        self._last: list[str] | None = None
        self._changed = False

    def restart(self, reconstructor: Reconstructor | None) -> None:
        """Begin again, from the present counts of a reconstructor on."""
        self._last, self._changed = None, False
        self.count_from(reconstructor)

    def count_from(self, reconstructor: Reconstructor | None) -> None:
        """Count from the present counts of a reconstructor on, ``None`` for one yet to come."""
        self._counts_before = {} if reconstructor is None else reconstructor.counters

    def note_change(self) -> None:
        """Warn of a modulation that was changed while it was on."""
        self._changed = True

    def end(self, lines: list[str]) -> None:
        """Keep these lines: the light ends."""
        self._last = lines

    def lines(
        self, reconstructor: Reconstructor | None, wanted: Settings, laser_hz: float
    ) -> list[str]:
        """Return one line for each reason.

        - ``wanted``: The settings, of which a modulation may allow less.
        - ``laser_hz``: Frequency that the laser reports, 0 while unknown.
        """
        if self._last is not None:
            return self._last
        if reconstructor is None:
            return []
        found = []
        used_hz, used = reconstructor.modulation.frequency_hz, reconstructor.settings
        if used.periods_per_profile < wanted.periods_per_profile:
            found.append(
                f"periods_per_profile is {wanted.periods_per_profile}; {used_hz:g} Hz allows "
                f"{used.periods_per_profile}"
            )
        if laser_hz and abs(used_hz / laser_hz - 1.0) > _OTHER_FREQUENCY:
            found.append(
                f"frequency is {used_hz:g} Hz and the laser reports {laser_hz:g} Hz; correct it, "
                "or set it to 0"
            )
        if self._changed:
            found.append("the laser's modulation was changed while it was on")
        return [*found, *reconstructor.warnings_since(self._counts_before)]
