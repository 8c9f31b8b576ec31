"""What is done to finished profiles before they are handed out."""

from __future__ import annotations

from dataclasses import replace

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.profiles import Profiles
from eschorty_ros.core.reflectance import relative_reflectance
from eschorty_ros.core.settings import Settings
from eschorty_ros.core.step_compensation import StepCompensator


class Finisher:
    """Adds to whole profiles what the settings ask for.

    Parameters
    ----------
    settings : Settings
    model : RangeModel
    """

    def __init__(self, settings: Settings, model: RangeModel) -> None:
        self._settings = settings
        self._model = model
        self._compensator: StepCompensator | None = None
        self._left = Profiles.empty()
        self._compensated_before = 0

    @property
    def columns_compensated(self) -> int:
        """Points whose row was corrected for a reflectance step."""
        now = self._compensator.columns_compensated if self._compensator is not None else 0
        return self._compensated_before + now

    def restart(self, modulation: Modulation, last: Profiles) -> None:
        """Profiles of another grid follow; ``last`` and those held back come out with them."""
        self._left = Profiles.concatenate([self.push(last), self.flush()])
        if self._settings.reflectance_compensation == "off" or not self._settings.stage_speed_mm_s:
            return
        self._compensated_before = self.columns_compensated
        self._compensator = StepCompensator(self._settings, self._model, modulation)

    def push(self, profiles: Profiles) -> Profiles:
        """Take profiles as they are completed and return those that are finished."""
        profiles = self._with_reflectance(profiles)
        if self._compensator is not None:
            profiles = self._compensator.push(profiles)
        return self._with_left(profiles)

    def flush(self) -> Profiles:
        """Everything held back."""
        rest = self._compensator.flush() if self._compensator is not None else Profiles.empty()
        return self._with_left(rest)

    def _with_left(self, profiles: Profiles) -> Profiles:
        if len(self._left) == 0:
            return profiles
        left, self._left = self._left, Profiles.empty()
        return Profiles.concatenate([left, profiles])

    def _with_reflectance(self, profiles: Profiles) -> Profiles:
        if self._settings.reflectance == "off" or len(profiles) == 0:
            return profiles
        reflectance, sigma = relative_reflectance(
            profiles.edge_us,
            profiles.width_px,
            profiles.events,
            self._settings.footprint_sigma_px,
            self._settings.white_width_px,
        )
        return replace(profiles, reflectance=reflectance, reflectance_sigma=sigma)
