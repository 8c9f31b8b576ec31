"""The page in a real browser: a scan is started from it and its points appear."""

import io
import shutil
import socket

import numpy as np
import pytest
from eschorty_ros.action import Scan
from PIL import Image

from eschorty_ros.nodes.one_process.composition import bench_parameters, composition

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WAIT_MS = 120_000


@pytest.fixture
def page():
    """An empty page of a browser without a window."""
    if not BROWSER:
        pytest.skip("no Chromium or Chrome on this computer")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=FLAGS)
        yield browser.new_page(viewport={"width": 1280, "height": 900})
        browser.close()


def enter(field, text):
    """Fill in a field as slowly as a hand: viser drops changes that another follows in 50 ms."""
    field.fill(text)
    field.press("Tab")
    field.page.wait_for_timeout(500.0)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def coloured_share(page):
    """Share of the left part of the page, without panels, that is neither grey nor white."""
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), np.int16)
    scene = picture[200:700, 300:900]
    return np.mean(np.ptp(scene, axis=2) > 40)


def test_a_scan_is_started_from_the_page_and_its_points_appear(page, tmp_path):
    tables = bench_parameters()
    tables["reconstruction"].update(calibration="config_3")
    tables["viewer"] = {"port": free_port(), "allow_scan": True}
    bench = {"scene": "steps", "calibration": "config_3", "seed": 1}
    with composition(tables, (Scan, "scan"), bench) as running:
        running.wait_until_active(lambda share, note: None)
        viewer = next(node for node in running.nodes if node.get_name() == "viewer")
        page.goto(viewer.page.url)
        page.get_by_role("button", name="Start scan").wait_for(timeout=WAIT_MS)
        assert coloured_share(page) < 0.001
        page.get_by_role("button", name="Start scan").click()
        page.get_by_text("the code is not the one").wait_for(timeout=WAIT_MS)
        enter(page.get_by_label("stop (mm)"), "24")
        enter(page.get_by_label("passes"), "2")
        record, code = page.locator("input.mantine-TextInput-input:visible").all()[-2:]
        enter(record, str(tmp_path / "records"))
        enter(code, viewer._control.code)
        page.get_by_role("button", name="Start scan").click()
        page.get_by_text("ON", exact=True).wait_for(timeout=WAIT_MS)
        page.get_by_text("requested: 10 to 24 mm at 50 mm/s, 70 Hz, passes: 2").wait_for()
        page.get_by_text("complete, ").wait_for(timeout=WAIT_MS)
        page.get_by_text("recorded into").wait_for(timeout=WAIT_MS)
        page.screenshot(path=tmp_path / "page.png")
        assert page.get_by_text("off", exact=True).count() == 1
        assert coloured_share(page) > 0.02
        shown = viewer._cloud.shown()
        assert len(shown.xyz) > 10_000
        assert set(shown.values["pass"]) == {1.0, 2.0}
        [recording] = (tmp_path / "records").iterdir()
        assert (recording / "events.raw").stat().st_size > 100_000
    print(tmp_path / "page.png")
