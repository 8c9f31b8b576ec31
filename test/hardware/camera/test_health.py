"""The thread that polls a camera which answers late."""

import threading

from waiting import DEADLINE_S, wait_until

from eschorty_ros.hardware.camera.health import HealthMonitor


class Late:
    """A session whose first answer comes at ``go``."""

    def __init__(self):
        self.asked, self.go = threading.Event(), threading.Event()

    def is_streaming(self):
        self.asked.set()
        assert self.go.wait(DEADLINE_S)
        return True

    def temperature_c(self):
        return 20.0


def polling():
    return sum(thread.name == "EVK4 health" for thread in threading.enumerate())


def test_a_thread_that_outlasts_a_stop_does_not_go_on_with_the_next_start():
    session = Late()
    monitor = HealthMonitor(lambda: session)
    monitor.start()
    try:
        assert session.asked.wait(DEADLINE_S)
        monitor.stop()
        monitor.start()
        assert polling() == 2
        session.go.set()
        wait_until(lambda: polling() == 1, "the end of the first thread", 5.0)
    finally:
        session.go.set()
        monitor.stop()
