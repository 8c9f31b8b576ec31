"""The camera node as a process on the emulated bus of another: it ends well in every phase."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from event_camera_msgs.msg import EventPacket
from evk4_bench import OnDemand
from ros_process import NodeProcess, Observer, processes, wait_until
from short_folder import short_folder

from eschorty_ros.emulation.bus import UsbServer
from eschorty_ros.emulation.evk4 import Evk4Model, Phase
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.domain import free_domain

CAMERA = "eschorty_ros.nodes.camera.node"


@pytest.fixture
def socket() -> Iterator[Path]:
    with short_folder() as folder:
        yield folder / "usb.sock"


def end_well(camera: NodeProcess) -> None:
    begun_s = time.monotonic()
    assert camera.interrupt() == 0, camera.output
    print(f"ended after {time.monotonic() - begun_s:.2f} s")
    assert "Traceback" not in camera.output, camera.output


@pytest.mark.fault("shutdown at any time")
def test_ctrl_c_in_the_initialisation_and_while_streaming(socket: Path) -> None:
    """driver: cuts it short, camera released or powered down, exit 0; user reads: nothing."""
    model, domain = Evk4Model(source := OnDemand()), free_domain()
    backend = f"eschorty_ros.emulation.bus.usb_remote:backend?{socket}"
    nodes = {CAMERA: {"driver": "evk4", "backend": backend}}
    with UsbServer(socket, lambda: [model]):
        with processes(nodes, domain) as running:
            wait_until(lambda: model.claims, "the claim")
            end_well(running["camera"])
            # The line that follows the 2.6 s of initialisation.
            assert "1280 x 720" not in running["camera"].output
        wait_until(lambda: not model.claims, "the claim's end")
        with processes(nodes, domain) as running, Observer(domain) as observer:
            packets = observer.collect(EventPacket, "camera/events", qos.events())

            def arrived() -> bool:
                source.give(5)
                return len(packets) > 3

            wait_until(arrived, "packets")
            end_well(running["camera"])
        assert model.watch.phase is Phase.OFF
        wait_until(lambda: not model.claims, "the claim's end")
