"""The page's server without a browser: decimation, text, and when a scan may begin."""

import contextlib
import http.client
import queue
import socket
import sys
import time

import msgspec
import numpy as np
import pytest
import viser
from click.testing import CliRunner
from waiting import wait_until
from websockets import Subprotocol
from websockets.sync.client import connect

from eschorty_ros.cli import main
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.storage import POINT_DTYPE, write_cloud
from eschorty_ros.viewer.growing_cloud import GrowingCloud, colours
from eschorty_ros.viewer.page import Page, open_when_served, page_url
from eschorty_ros.viewer.scan_control import ABANDONED_S, Conditions, ScanControl, ScanValues
from eschorty_ros.viewer.status import Status, laser_text, points_text

CLOUD = "c.pcd"
READY = Conditions(scanner=True, laser=True, interlock_open=False)


def numbered(first, count):
    points = np.zeros(count, POINT_DTYPE)
    points["x"] = np.arange(first, first + count)
    return points


@pytest.mark.parametrize("batch", [1, 7, 64, 1000])
def test_every_nth_point_is_kept_in_any_batches(batch):
    cloud = GrowingCloud(limit=64)
    for first in range(0, 1000, batch):
        cloud.add(numbered(first, min(batch, 1000 - first)))
        shown = cloud.shown()
        assert len(shown.xyz) < 64 or shown.stride == 1
        expected = np.arange(0, shown.received, shown.stride)
        np.testing.assert_array_equal(shown.xyz[:, 0], expected)
    assert (shown.received, shown.stride) == (1000, 16)
    cloud.clear()
    assert len(cloud.shown().xyz) == 0


def test_the_pass_follows_from_the_direction_of_the_stage_in_any_batches():
    """Forth, back and forth at 50 mm/s and 70 Hz; events of a profile within 6 ms."""
    t_s = (np.arange(90)[:, None] / 70.0 + np.arange(40) % 7 * 1e-3).ravel()
    points = numbered(0, len(t_s))
    points["column"], points["t"] = np.tile(np.arange(40), 90), t_s
    way_s = t_s % (60 / 70.0)
    points["y"] = 0.01 + 0.05 * np.minimum(way_s, 60 / 70.0 - way_s)
    expected = 1 + np.arange(90).repeat(40) // 30
    for batch in (len(points), 130, 17):
        cloud = GrowingCloud()
        for first in range(0, len(points), batch):
            cloud.add(points[first : first + batch])
        number = cloud.shown().values["pass"]
        assert np.mean(number == expected) > (0.99 if batch > 40 else 0.95)
    cloud.add(points[:0])
    cloud.add(numbered(0, 1)[["x", "y", "z", "sigma"]])
    assert np.isnan(cloud.shown().values["pass"][-1])


def test_it_follows_1_28_million_points_per_second():
    """A second of points, in 20 batches, in a small part of a second."""
    cloud = GrowingCloud()
    batches = [numbered(k * 64_000, 64_000) for k in range(20)]
    cloud.add(batches[0])
    begun_s = time.process_time()
    for batch in batches:
        cloud.add(batch)
    cloud.shown()
    assert time.process_time() - begun_s < 0.3
    assert len(cloud.shown().xyz) <= 120_000


def test_colours_ignore_what_is_not_known():
    rgb, limits = colours(np.array([np.nan, 1.0, 2.0, 3.0, np.inf], np.float32))
    assert rgb.shape == (5, 3)
    assert limits == pytest.approx((1.02, 2.98))
    assert len({tuple(colour) for colour in rgb[1:4]}) == 3
    assert colours(np.empty(0, np.float32))[0].shape == (0, 3)
    with pytest.raises(ArgumentError, match="send x y z and sigma"):
        GrowingCloud().add(np.zeros(1, [("x", "f4")]))


@pytest.mark.parametrize(
    ("conditions", "words"),
    [
        (Conditions(), "no scanner"),
        (Conditions(scanner=True), "does not report"),
        (Conditions(scanner=True, laser=True), "interlock is open"),
        (Conditions(scanner=True, laser=True, interlock_open=False, scanning=True), "is running"),
    ],
)
def test_light_needs_every_condition(conditions, words):
    control = ScanControl(allowed=True)
    with pytest.raises(ArgumentError, match=words):
        control.start(ScanValues(), control.code, conditions)
    assert control.start(ScanValues(), f" {control.code} ", READY) == ScanValues()


def test_light_needs_the_switch_the_code_and_a_sweep():
    with pytest.raises(ArgumentError, match="--allow-scan"):
        ScanControl(allowed=False).start(ScanValues(), "", READY)
    control = ScanControl(allowed=True)
    with pytest.raises(ArgumentError, match="give a distance"):
        control.start(ScanValues(stop_mm=10.0), control.code, READY)
    with pytest.raises(ArgumentError, match="passes is 0"):
        control.start(ScanValues(passes=0), control.code, READY)
    with pytest.raises(ArgumentError, match="speed_mm_s is nan"):
        control.start(ScanValues(speed_mm_s=float("nan")), control.code, READY)
    for _ in range(5):
        with pytest.raises(ArgumentError, match="code is not"):
            control.start(ScanValues(), "00000000", READY)
    with pytest.raises(ArgumentError, match="too often"):
        control.start(ScanValues(), control.code, READY)
    assert ScanControl(allowed=True).code != control.code


def test_a_scan_that_no_page_follows_is_cancelled():
    now_s = [0.0]
    control = ScanControl(allowed=True, clock=lambda: now_s[0])
    now_s[0] = 100.0
    assert not control.abandoned(pages=0)
    control.start(ScanValues(), control.code, READY)
    now_s[0] += ABANDONED_S - 0.1
    assert not control.abandoned(pages=0)
    assert not control.abandoned(pages=1)
    now_s[0] += ABANDONED_S + 0.1
    assert control.abandoned(pages=0)
    control.ended()
    assert not control.abandoned(pages=0)


def test_the_text_names_laser_and_losses_and_carries_no_markup():
    status = Status(laser=laser_text(1, True), reason="a|b <img src=x>", phase="sweeping",
                    progress=0.5, counts={"packets_lost": 1234})  # fmt: skip
    text = status.markdown(10_000, 4)
    for words in ("**ON**", "sweeping 50%", "packets lost | 1,234", "10,000 points, 1 in 4 drawn"):
        assert words in text
    assert "<img" not in text
    assert [laser_text(*state) for state in ((0, True), (2, False), (77, True))] == [
        "off, armed", "unknown", "unknown",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "arguments", [(), ("--allow-scan", CLOUD), ("--live", CLOUD), ("--browser", "--window", CLOUD)]
)
def test_view_refuses_what_does_not_go_together(tmp_path, arguments):
    write_cloud(tmp_path / CLOUD, numbered(0, 10))
    given = [str(tmp_path / CLOUD) if text == CLOUD else text for text in arguments]
    assert CliRunner().invoke(main, ["view", *given]).exit_code == 2


def test_a_page_without_viser_or_on_a_taken_port_is_one_line(tmp_path, monkeypatch):
    write_cloud(tmp_path / CLOUD, numbered(0, 10))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        view = ["view", str(tmp_path / CLOUD), "--browser", "--port", port]
        done = CliRunner().invoke(main, view)
        assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
        assert "choose another --host or --port" in done.stderr
    monkeypatch.setitem(sys.modules, "viser", None)
    done = CliRunner().invoke(main, view)
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert "pip install viser" in done.stderr


@pytest.fixture
def served():
    """A page with a cloud, on a free port of this computer."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    page = Page(GrowingCloud(), port=port)
    yield page
    page.stop()


@pytest.mark.parametrize(
    ("name", "origin", "status"),
    [
        ("127.0.0.1", None, 200),
        ("127.0.0.1", "http://127.0.0.1", 200),
        ("localhost", "http://localhost", 200),
        ("[::1]", "https://[::1]", 200),
        ("127.0.0.1", "http://localhost", 403),
        ("127.0.0.1", "http://other.example", 403),
        ("127.0.0.1", "null", 403),
        ("other.example", None, 403),
        ("other.example", "http://other.example", 403),
    ],
)
def test_only_the_pages_own_requests_are_answered(served, name, origin, status):
    """Those of other sites in the same browser are not: by file or by socket."""
    port = served.server.get_port()
    headers = {"Host": f"{name}:{port}"}
    if origin is not None:
        headers["Origin"] = origin if origin == "null" else f"{origin}:{port}"
    socket_headers = {
        "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }  # fmt: skip
    for more, wanted in (({}, status), (socket_headers, 101 if status == 200 else status)):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)
        connection.request("GET", "/", headers=headers | more)
        assert connection.getresponse().status == wanted
        connection.close()


def test_the_address_of_a_page_can_be_opened():
    assert page_url("127.0.0.1", 8535) == "http://127.0.0.1:8535"
    assert page_url("::1", 8535) == "http://[::1]:8535"
    # Those of all interfaces are no address of a server.
    for host in ("0.0.0.0", "::"):
        assert page_url(host, 8535) == f"http://{socket.gethostname()}:8535"


def test_a_page_is_served_on_an_ipv6_address():
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6) as probe:
            port = probe.getsockname()[1]
    except OSError:
        pytest.skip("this computer has no IPv6")
    page = Page(GrowingCloud(), host="::1", port=port)
    connection = http.client.HTTPConnection("::1", port, timeout=10.0)
    connection.request("GET", "/")
    assert connection.getresponse().status == 200
    connection.close()
    page.stop()


@contextlib.contextmanager
def connected(page, **options):
    """A client of ``page`` that looks along x, without a browser."""
    url = f"ws://127.0.0.1:{page.server.get_port()}"
    own = Subprotocol(f"viser-v{viser.__version__}")
    with connect(url, subprotocols=[own], max_size=None, **options) as client:
        look_from(client, (0, 0, 0))
        yield client


def look_from(client, position):
    camera = {
        "type": "ViewerCameraMessage", "wxyz": (1, 0, 0, 0), "position": position, "fov": 1.0,
        "near": 0.1, "far": 10.0, "image_height": 100, "image_width": 100, "look_at": (1, 0, 0),
        "up_direction": (0, 0, 1),
    }  # fmt: skip
    client.send(msgspec.msgpack.encode(camera))


def test_the_view_follows_a_cloud_that_grows_until_its_user_changes_it(served):
    with connected(served, max_queue=None) as client:
        wait_until(lambda: served.pages == 1, "the page")
        [camera] = (page.camera for page in served.server.get_clients().values())
        distances_m = []
        for size_m in (0.05, 0.1, 0.2):
            points = numbered(0, 100)
            points["x"], points["y"], points["z"] = 1.0, np.linspace(0.0, size_m, 100), 0.0
            served._cloud.add(points)
            served.show(points_text)
            distances_m.append(np.linalg.norm(camera.position - [1.0, size_m / 2.0, 0.0]))
        assert np.all(np.diff(distances_m) > 0.03)
        own = (0.5, 0.4, 0.3)
        look_from(client, own)
        wait_until(lambda: np.allclose(camera.position, own), "the user's view")
        points["y"] *= 10.0
        served._cloud.add(points)
        served.show(points_text)
        assert np.allclose(camera.position, own)


def test_a_page_that_reads_nothing_is_no_open_page(served):
    """A computer that has vanished or stalled keeps no scan going."""
    with connected(served, max_queue=None), connected(served, max_queue=1) as stalled:
        wait_until(lambda: served.pages == 2, "both pages")
        end_s = time.monotonic() + 30.0
        while served.pages > 1:
            assert time.monotonic() < end_s, "still counted"
            served._cloud.add(numbered(0, 50_000))
            served.show(points_text)
            time.sleep(0.1)
        assert served.pages == 1
        stalled.socket.close()


def test_no_page_opens_a_way_into_the_internet(served, monkeypatch):
    tunnels = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *where: tunnels.append(where))
    assert served.server.request_share_url() is None
    assert tunnels == []


def test_a_page_is_opened_on_a_desktop_once_it_is_served(monkeypatch):
    opened = queue.Queue()
    monkeypatch.setattr("webbrowser.open", opened.put)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = probe.getsockname()
    monkeypatch.setenv("DISPLAY", ":0")
    open_when_served(*address)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    open_when_served(*address)
    time.sleep(0.1)
    assert opened.empty()
    with socket.create_server(address):
        assert opened.get(timeout=10.0) == "http://{}:{}".format(*address)
        with pytest.raises(ArgumentError, match="choose another --host or --port"):
            open_when_served(*address)
    assert opened.empty()
