"""What is done to finished profiles before they are handed out."""

from __future__ import annotations

from dataclasses import replace

from eschorty_ros.core.profiles import Profiles
from eschorty_ros.core.reflectance import relative_reflectance
from eschorty_ros.core.settings import Settings


class Finisher:
    """Adds to whole profiles what the settings ask for.

    Parameters
    ----------
    settings : Settings
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def push(self, profiles: Profiles) -> Profiles:
        """Take profiles as they are completed and return those that are finished."""
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
