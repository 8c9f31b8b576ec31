"""All nodes in one process under ROS, for small computers: ``ros2 run eschorty_ros instrument``."""

from __future__ import annotations

import sys

from eschorty_ros.nodes.one_process.composition import NODES, THREADS
from eschorty_ros.nodes.ros.spin import run


def main() -> int:
    """Run camera, laser, stage, reconstruction and scanner until a signal."""
    return run(*NODES.values(), threads=THREADS)


if __name__ == "__main__":
    sys.exit(main())
