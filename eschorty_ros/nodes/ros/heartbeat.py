"""Sign of life of a node whose failure must darken the laser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rclpy.node import Node
from std_msgs.msg import Header

from eschorty_ros.control.peer import own_sign
from eschorty_ros.hardware.base.stalls import OwnPauses
from eschorty_ros.nodes.ros import qos

PERIOD_S = 0.1
LOOK_S = 0.02
LAST_BEATS = 3
# No device is called late for less, and each is heard of again within so many looks after it.
PAUSE_S = 0.3
RECOVERY_LOOKS = 10


class Heartbeat:
    """Publishes a ``std_msgs/Header`` every 0.1 s for as long as ``healthy()`` is true.

    The header's ``frame_id`` says which process beats (see ``peer``), so that a laser node on the
    same host sees it die; the last beats say that they are the last. In a thread of its own, so
    that a busy executor does not look like a dead device; it ends with the node's context. After a
    pause of the process itself the device gets 0.2 s to be heard of again.

    Parameters
    ----------
    node : rclpy.node.Node
    topic : str
        ``camera/heartbeat`` or the like.
    healthy : callable
        Whether the device does what it should, right now; called in the thread, must not wait.

    Attributes
    ----------
    beating : bool
        Whether the last beat said that all is well.
    """

    def __init__(self, node: Node, topic: str, healthy: Callable[[], bool]) -> None:
        self._node = node
        self._healthy = healthy
        self.beating = False
        self._publisher = node.create_publisher(Header, topic, qos.heartbeat())
        threading.Thread(target=self._run, name=topic, daemon=True).start()

    def _run(self) -> None:
        pause = threading.Event()
        last_beats = 0
        recovering = 0
        beat_s = 0.0
        own_pauses = OwnPauses(LOOK_S)
        while not pause.wait(LOOK_S) and self._node.context.ok():
            healthy, now_s = self._asked(), time.monotonic()
            paused = own_pauses.look() > PAUSE_S
            recovering = RECOVERY_LOOKS if paused else max(recovering - 1, 0)
            healthy |= self.beating and recovering > 0
            if healthy:
                last_beats = LAST_BEATS
            due = healthy != self.beating or now_s - beat_s >= PERIOD_S
            if not due or last_beats == 0:
                continue
            if not self._publish(stopped=not healthy):
                return
            self.beating, beat_s = healthy, now_s
            last_beats -= not healthy

    def _asked(self) -> bool:
        try:
            return self._healthy()
        except Exception as error:
            self._node.get_logger().error(f"health not known: {error!r}", once=True)
            return False

    def _publish(self, *, stopped: bool) -> bool:
        message = Header(
            stamp=self._node.get_clock().now().to_msg(), frame_id=own_sign(stopped=stopped)
        )
        try:
            self._publisher.publish(message)
        except Exception:
            # A signal may end the context, or the node be destroyed, in between.
            return False
        return True
