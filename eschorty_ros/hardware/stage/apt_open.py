"""The stage opened on its serial port, with the link's threads running."""

from __future__ import annotations

from collections.abc import Callable

from eschorty_ros.core.errors import DeviceError
from eschorty_ros.hardware.stage import apt_messages as apt
from eschorty_ros.hardware.stage.apt_link import AptLink
from eschorty_ros.hardware.stage.apt_port import find_port, open_port
from eschorty_ros.hardware.stage.apt_setup import AptSettings
from eschorty_ros.hardware.stage.apt_stage import AptStage


def open_stage(
    settings: AptSettings, clock_ns: Callable[[], int], port: str = "", serial: str = ""
) -> AptStage:
    """Open the stage on ``port``, or on the port whose USB serial number is ``serial``.

    Raises
    ------
    DeviceError
        With the remedy when there is no such port or no such stage behind it.
    """
    opened = open_port(port or find_port(settings.controller, serial))

    def make_link(
        on_frame: Callable[[apt.Frame, int], None], on_lost: Callable[[DeviceError], None]
    ) -> AptLink:
        link = AptLink(opened, on_frame, on_lost)
        link.start()
        return link

    return AptStage(make_link, clock_ns, settings)
