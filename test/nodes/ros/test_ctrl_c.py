"""Ctrl-C with both cores busy, in the middle of a sweep: every node ends quickly and silently."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import scan_scenarios as scenarios
from benches import remote_bench
from ros_process import processes

from eschorty_ros.nodes.ros.domain import free_domain

STRAY = ("Traceback", "context is", "Destroyable", "RCLError", "Exception", "not safe", "Invalid")


def test_ctrl_c_in_a_sweep_on_a_busy_machine(tmp_path: Path) -> None:
    log, domain = tmp_path / "output.log", free_domain()
    with (
        remote_bench(**scenarios.bench_settings(log)) as (_, folder),
        processes(scenarios.node_parameters(folder), domain) as running,
    ):
        with scenarios.bench(domain, log) as bench:
            bench.start(**scenarios.SLOW)
            bench.wait_for_sweep()
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
        try:
            before = {name: len(process.output) for name, process in running.items()}
            begun_s, ended_s = time.monotonic(), {}
            for process in running.values():
                process.send(signal.SIGINT)
            while len(ended_s) < len(running) and time.monotonic() < begun_s + 60.0:
                for name, process in running.items():
                    if name not in ended_s and not process.running():
                        ended_s[name] = time.monotonic() - begun_s
                time.sleep(0.01)
        finally:
            for process in busy:
                process.kill()
                process.wait()
        print({name: round(after_s, 2) for name, after_s in ended_s.items()})
        for name, process in running.items():
            printed = process.output[before[name] :]
            print(f"--- {name}\n{printed}")
            assert process.wait() == 0
            assert not [word for word in STRAY if word in printed]
        assert log.read_text().splitlines()[-1].endswith("OFF")
