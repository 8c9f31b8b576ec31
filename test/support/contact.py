"""The contact of the laser's interlock, as a node of the instrument publishes it."""

import threading

from ros_process import Observer, wait_until
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from eschorty_ros.nodes.ros import qos

PERIOD_S = 0.1


class Contact:
    """Reports on ``laser/interlock`` from the first call on, as long as the observer spins."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self._publisher = observer.publisher(Bool, "laser/interlock", qos.stream(10))
        self._lock = threading.Lock()
        self._open: bool | None = None
        self._timer = observer.node.create_timer(PERIOD_S, self._report)

    def open(self) -> None:
        """Open it; reported on return."""
        self._set(True)

    def close(self) -> None:
        """Close it and reset the interlock."""
        self._set(False)
        wait_until(self.reset, "the interlock closed", poll_s=PERIOD_S)

    def reset(self) -> bool:
        """Return whether the laser node accepts a reset."""
        answer = self._observer.call(Trigger, "laser/reset_interlock")
        print("reset:", answer.message)
        return bool(answer.success)

    def end(self) -> None:
        """Report nothing more."""
        self._observer.node.destroy_timer(self._timer)

    def _set(self, is_open: bool) -> None:
        with self._lock:
            self._open = is_open
            self._publisher.publish(Bool(data=is_open))

    def _report(self) -> None:
        with self._lock:
            if self._open is not None:
                self._publisher.publish(Bool(data=self._open))
