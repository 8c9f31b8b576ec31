"""Every test process talks in a ROS domain of its own, on this host only, and ends."""

import faulthandler
import os
import sys

import pytest

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

_END_S = 60.0


@pytest.fixture(scope="session")
def open3d():
    """Open3D, or a skip that says what it lacks."""
    from eschorty_ros.core.base.errors import EschortyError
    from eschorty_ros.simulation.scenes import load_open3d

    try:
        return load_open3d("this test")
    except EschortyError as error:
        pytest.skip(str(error))


def pytest_unconfigure() -> None:
    """End the process, with its stacks, where a thread that a test has left would keep it."""
    faulthandler.dump_traceback_later(_END_S, exit=True, file=sys.__stderr__)
