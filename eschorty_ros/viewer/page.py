"""The page: viser serves it, draws the points in the browser and reconnects by itself.

viser was chosen over rerun: both draw points well, but rerun's page has no controls of one's own,
so a scan could not be started from it.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from ipaddress import ip_address
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError, EschortyError
from eschorty_ros.viewer.growing_cloud import COLOURS, GrowingCloud, colours
from eschorty_ros.viewer.scan_control import ScanControl, ScanValues

HOST, PORT = "127.0.0.1", 8080
_FRAME_STEP = 2
_NAMES = {
    "start_mm": "start (mm)", "stop_mm": "stop (mm)", "speed_mm_s": "speed (mm/s)",
    "frequency_hz": "frequency (Hz)", "duty": "duty, 0: as it is", "passes": "passes",
    "record": "record into",
}  # fmt: skip
_AHEAD = 0.9
# Growth of a cloud that the pages follow.
_GROWTH = 1.2
_ROUNDED_M = 1e-4
_SERVED_S, _POLL_S = 300.0, 0.5
_UNREAD_S = 5.0


def load_viser() -> ModuleType:
    """Import ``viser``; EschortyError with one line of advice when it is not installed."""
    try:
        import viser
    except ImportError as error:
        raise EschortyError(
            f"the page in the browser needs viser ({error}); run: pip install viser"
        ) from error
    module: ModuleType = viser
    return module


class Page:
    """A page that shows a cloud, and an instrument if there is one.

    - ``control``: Without one the page shows a saved cloud only.

    Raises ``ArgumentError`` when the port is taken. Raises ``EschortyError`` without viser.
    """

    def __init__(
        self,
        cloud: GrowingCloud,
        control: ScanControl | None = None,
        host: str = HOST,
        port: int = PORT,
    ) -> None:
        viser = load_viser()
        _check_free(host, port)
        self._cloud = cloud
        self._control = control
        self._drawn: tuple[int, str, float] | None = None
        self._points: Any = None
        self._box: _Box | None = None
        self._aims: dict[int, NDArray[np.float64]] = {}
        self._lock = threading.Lock()
        # A stopped server takes no more.
        self._serving = threading.Lock()
        self._stopped = False
        self._start: tuple[ScanValues, str] | None = None
        self._cancel = False
        # viser prints lines of its own.
        with contextlib.redirect_stdout(None), _guarded(host):
            self.server = _private(viser)(host=host, port=port, label="eschorty", verbose=False)
        self.url = page_url(host, self.server.get_port())
        self.server.scene.set_up_direction("+z")
        self._build()
        self.server.on_client_connect(self._connected)

    def _build(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_share_button=False, show_logo=False)
        self._colour = gui.add_dropdown("colour", COLOURS)
        self._size = gui.add_slider("point size (mm)", 0.1, 5.0, 0.1, 0.8)
        self._scale = gui.add_image(_scale_image(), format="png")
        self._text = gui.add_markdown("")
        if self._control is None:
            return
        self._profile: Any = None
        self._profile_folder = gui.add_folder("profile: range over z, mm")
        with gui.add_folder("events"):
            self._frame = gui.add_image(np.zeros((36, 64, 3), np.uint8), format="jpeg")

    def _connected(self, client: Any) -> None:
        """Aim the camera and give the page its controls: no other page sees its code."""
        self._aim(client)
        if self._control is None or not self._control.allowed:
            return
        with client.gui.add_folder("scan"):
            fields = {}
            for name, value in ScanValues()._asdict().items():
                add = client.gui.add_text if isinstance(value, str) else client.gui.add_number
                fields[name] = add(_NAMES[name], value)
            code = client.gui.add_text("code", "")
            start = client.gui.add_button("Start scan", color="red")
            cancel = client.gui.add_button("Cancel scan")

        def request(_: Any) -> None:
            values = ScanValues(**{name: field.value for name, field in fields.items()})
            with self._lock:
                self._start = values, str(code.value)

        def request_cancel(_: Any) -> None:
            with self._lock:
                self._cancel = True

        start.on_click(request)
        cancel.on_click(request_cancel)

    def requests(self) -> tuple[tuple[ScanValues, str] | None, bool]:
        """Return the scan that was requested, with the code, and whether to cancel; once each."""
        with self._lock:
            asked, self._start, self._cancel = (self._start, self._cancel), None, False
        return asked

    @property
    def pages(self) -> int:
        """Return how many pages are open."""
        return len(self.server.get_clients())

    def show(
        self,
        text: Callable[[int, int], str],
        profile: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
        frame: NDArray[np.uint8] | None = None,
    ) -> None:
        """Draw what has changed.

        - ``text``: Returns the text, of received points and stride.
        - ``profile``: z and range of one period, mm.
        - ``frame``: Shape (rows, columns). Image of the recent events.
        """
        with self._serving:
            if self._stopped:
                return
            self._show(text)
            if profile is not None and len(profile[0]):
                self._show_profile(*profile)
            if frame is not None:
                small = frame[::_FRAME_STEP, ::_FRAME_STEP]
                self._frame.image = np.repeat(small[:, :, None], 3, axis=2)

    def _show(self, text: Callable[[int, int], str]) -> None:
        colour, size_mm = str(self._colour.value), float(self._size.value)
        state = self._cloud.changes, colour, size_mm
        if state != self._drawn:
            self._drawn = state
            shown = self._cloud.shown()
            self._limits = self._draw(shown.xyz, shown.values[colour], size_mm)
            self._counts = shown.received, shown.stride
        low, high = self._limits
        unit = " m" if colour in ("range", "sigma") else ""
        scale = f"\n\n{colour}: {low:.4g} to {high:.4g}{unit}" if high > low else ""
        self._text.content = text(*self._counts) + scale

    def _draw(
        self, xyz: NDArray[np.float32], values: NDArray[np.float32], size_mm: float
    ) -> tuple[float, float]:
        rgb, limits = colours(values)
        if not len(xyz):
            self._box = None
            if self._points is not None:
                self._points.remove()
                self._points = None
            return limits
        box = _extent(xyz)
        if self._box is None or box.size_m > _GROWTH * self._box.size_m:
            self._box = box
            for client in self.server.get_clients().values():
                self._aim(client)
        self._points = self.server.scene.add_point_cloud(
            "/cloud", xyz, rgb, point_size=size_mm * 1e-3, precision="float32",
            point_shading="flat", point_shape="circle",
        )  # fmt: skip
        return limits

    def _aim(self, client: Any) -> None:
        """Look at the cloud from the instrument's side, unless the page's user looks elsewhere."""
        if self._box is None:
            return
        aimed = self._aims.get(client.client_id, client.camera.position)
        # The browser rounds.
        if not np.allclose(client.camera.position, aimed, atol=_ROUNDED_M):
            return
        back = _AHEAD * self._box.size_m
        aim = self._box.centre_m + np.array([-back, -0.4 * back, 0.3 * back])
        client.camera.position = self._aims[client.client_id] = aim
        client.camera.look_at = self._box.centre_m

    def _show_profile(self, z_mm: NDArray[np.float64], range_mm: NDArray[np.float64]) -> None:
        from viser import uplot

        order = np.argsort(z_mm)
        data = z_mm[order], range_mm[order]
        if self._profile is None:
            with self._profile_folder:
                self._profile = self.server.gui.add_uplot(
                    data, (uplot.Series(label="z"), uplot.Series(label="range", stroke="red")),
                    scales={"x": uplot.Scale(time=False)}, aspect=1.6,
                )  # fmt: skip
        else:
            self._profile.data = data

    def stop(self) -> None:
        """End the server."""
        with self._serving, contextlib.redirect_stdout(None):
            self._stopped = True
            self.server.stop()


class _Box(NamedTuple):
    """Centre and largest extent of the central 98 % of the points along each axis."""

    centre_m: NDArray[np.float64]
    size_m: float


def _extent(xyz: NDArray[np.float32]) -> _Box:
    low, high = np.percentile(xyz, (1.0, 99.0), axis=0)
    return _Box((low + high) / 2.0, max(float((high - low).max()), 0.02))


def _scale_image() -> NDArray[np.uint8]:
    """Return the colours from the least to the greatest value, left to right."""
    return np.tile(colours(np.linspace(0.0, 1.0, 640, dtype=np.float32))[0], (24, 1, 1))


def _private(viser: ModuleType) -> Any:
    """Return viser's server without its way into the internet, which any page may ask for."""

    class Private(viser.ViserServer):  # type: ignore[name-defined]
        def request_share_url(self, verbose: bool = True) -> None:
            """Open no tunnel."""

    return Private


@contextlib.contextmanager
def _guarded(host: str) -> Iterator[None]:
    """Make a server that viser starts meanwhile refuse other sites, and pages that read nothing.

    A browser lets every site connect to it. viser has no setting for either.
    """
    from websockets.asyncio import server

    serve, served = server.serve, []

    def serve_guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            sent = (request.headers.get_all(name) for name in ("Host", "Origin"))
            if refusal := foreign(host, *sent):
                return connection.respond(403, f"{refusal}\n")
            # A computer that vanishes closes nothing; pings wait behind what it has not read.
            connection.transport.get_extra_info("socket").setsockopt(
                socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(_UNREAD_S * 1e3)
            )
            return process_request(connection, request)

        served.append(host)
        return serve(*arguments, process_request=check, **options)

    server.serve = serve_guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]
    if not served:
        raise EschortyError("this viser cannot keep other sites out; run: pip install viser==1.1.1")


def foreign(host: str, asked: Sequence[str], origins: Sequence[str]) -> str:
    """Return why a request is not one of the page's own, ``""`` when it is.

    - ``host``: Address that is served on.
    - ``asked``: The request's headers ``Host``.
    - ``origins``: Its headers ``Origin``, which a browser adds to a page's requests.
    """
    if len(asked) != 1:
        return "give one Host"
    if any(origin not in (f"http://{asked[0]}", f"https://{asked[0]}") for origin in origins):
        return f"pages of {', '.join(origins)} are refused; open http://{asked[0]}"
    # Another site may give its name the address of this computer.
    if _is_loopback(host) and not _is_loopback(re.sub(r":\d+$", "", asked[0]).strip("[]")):
        return f"the name {asked[0]} is refused; use {host}, or start with another --host"
    return ""


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def page_url(host: str, port: int) -> str:
    """Return the address of a page, by this computer's name where it is served on every address."""
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    return f"http://[{name}]:{port}" if ":" in name else f"http://{name}:{port}"


def open_when_served(host: str, port: int) -> None:
    """Open the page in the browser of a desktop, if this is one, once its server answers.

    Raises ``ArgumentError`` when the port is taken already.
    """
    _check_free(host, port)
    if not any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        return

    def wait() -> None:
        end_s = time.monotonic() + _SERVED_S
        while time.monotonic() < end_s:
            with contextlib.suppress(OSError):
                socket.create_connection((host, port), 1.0).close()
                webbrowser.open(page_url(host, port))
                return
            time.sleep(_POLL_S)

    threading.Thread(target=wait, name="browser", daemon=True).start()


def _check_free(host: str, port: int) -> None:
    """Refuse a port that is taken; viser would take another one and not report it."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise ArgumentError(
            f"{host}:{port} cannot be served ({error.strerror}); choose another --host or --port"
        ) from error
