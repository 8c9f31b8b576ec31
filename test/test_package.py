"""What the package promises to other ROS 2 software and to those who install it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EVENT_PACKET_HASH = "RIHS01_d6fa176260b1f37e5a40845305315e150a0f18191241eb64f407442aa29844aa"


def _share(package: str) -> Path:
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        share = Path(prefix) / "share" / package
        if prefix and share.is_dir():
            return share
    pytest.fail(f"{package} is in no folder of AMENT_PREFIX_PATH; source the setup script")


def test_event_packet_is_the_public_one() -> None:
    description = json.loads((_share("event_camera_msgs") / "msg/EventPacket.json").read_text())
    hashes = {entry["type_name"]: entry["hash_string"] for entry in description["type_hashes"]}
    assert hashes["event_camera_msgs/msg/EventPacket"] == EVENT_PACKET_HASH


def test_every_interface_of_the_source_is_built() -> None:
    share = _share("eschorty_ros")
    for kind in ("msg", "srv", "action"):
        sources = {path.stem for path in (ROOT / kind).glob(f"*.{kind}")}
        assert sources
        assert sources == {path.stem for path in (share / kind).glob(f"*.{kind}")}


def test_installed_layout() -> None:
    share = _share("eschorty_ros")
    prefix = share.parents[1]
    for folder in ("config", "launch"):
        names = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        assert names <= {path.name for path in (share / folder).iterdir()}
    for script in (*(prefix / "lib" / "eschorty_ros").iterdir(), prefix / "bin" / "eschorty"):
        assert os.access(script, os.X_OK)


def test_both_lists_of_python_packages_are_the_same() -> None:
    keys = {"pyserial": "serial", "pyusb": "usb", "pyyaml": "yaml"}
    lines = (ROOT / "requirements" / "run.txt").read_text().splitlines()
    names = [line.partition(">")[0] for line in lines if line and not line.startswith("#")]
    needed = {element.text for element in ElementTree.parse(ROOT / "package.xml").iter()}
    assert names
    assert {f"python3-{keys.get(name, name)}" for name in names} <= needed


def test_versions_agree() -> None:
    import eschorty_ros

    manifest = ElementTree.parse(ROOT / "package.xml").findtext("version")
    assert manifest == eschorty_ros.__version__
    assert f'version="{manifest}"' in (ROOT / "setup.py").read_text()


@pytest.mark.parametrize(
    "module", ["cli", "core.calibration", "simulation.scenes", "report", "live", "control"]
)
def test_imports_without_ros(module: str) -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None; "
        f"import eschorty_ros.{module}; "
        "assert 'open3d' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300, cwd=ROOT)
