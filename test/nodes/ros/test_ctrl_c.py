"""Ctrl-C with both cores busy: every node ends quickly and silently, alone or with the others."""

import contextlib
import errno
import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import scan_scenarios as scenarios
import yaml
from benches import remote_bench
from ros_process import (
    NAMESPACE,
    NodeProcess,
    Observer,
    domain_environment,
    node_name,
    processes,
)
from std_msgs.msg import Header
from waiting import wait_until

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.domain import free_domain
from eschorty_ros.nodes.ros.spin import make_safe

# Runs a node's ``main`` and prints the threads of DDS that are left.
ENDED = """
import contextlib, pathlib, runpy, sys
with contextlib.suppress(SystemExit):
    runpy.run_module(sys.argv.pop(1), run_name="__main__")
names = [path.read_text().strip() for path in pathlib.Path("/proc/self/task").glob("*/comm")]
print("left:", *(name for name in names if name.startswith("dds.udp")))
"""
UNWANTED = (
    "Traceback",
    "context is",
    "Destroyable",
    "RCLError",
    "Exception",
    "not safe",
    "Invalid",
)


@contextlib.contextmanager
def busy() -> Iterator[None]:
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        yield
    finally:
        for process in loops:
            process.kill()
            process.wait()


def assert_ctrl_c_ends(running: Mapping[str, NodeProcess]) -> None:
    before = {name: len(process.output) for name, process in running.items()}
    ended_s: dict[str, float] = {}
    with busy():
        begun_s = time.monotonic()
        for process in running.values():
            process.send(signal.SIGINT)
        while len(ended_s) < len(running) and time.monotonic() < begun_s + 60.0:
            for name, process in running.items():
                if not process.running():
                    ended_s.setdefault(name, time.monotonic() - begun_s)
            time.sleep(0.01)
    print({name: round(after_s, 2) for name, after_s in ended_s.items()})
    for name, process in running.items():
        printed = process.output[before[name] :]
        print(f"--- {name}\n{printed}")
        assert process.wait() == 0
        assert not [word for word in UNWANTED if word in printed]


def test_in_the_middle_of_a_sweep(tmp_path: Path) -> None:
    log, domain = tmp_path / "output.log", free_domain()
    with (
        remote_bench(**scenarios.bench_settings(log)) as (_, folder),
        processes(scenarios.node_parameters(folder), domain) as running,
    ):
        with scenarios.bench(domain, log) as bench:
            bench.start(**scenarios.SLOW)
            bench.wait_for_sweep()
        with Observer(domain) as observer:
            listed = observer.node.get_node_names
            wait_until(lambda: set(running) <= set(listed()), "the nodes")
            assert_ctrl_c_ends(running)
            # DDS would forget a node that it does not see leave after 20 s.
            wait_until(lambda: not set(running) & set(listed()), "the end of all nodes", 2.0)
        assert log.read_text().splitlines()[-1].endswith("OFF")


def test_dds_has_ended_before_the_process() -> None:
    node = "eschorty_ros.nodes.scanner.node", "--ros-args", "-r", f"__ns:={NAMESPACE}"
    command = [sys.executable, "-c", ENDED, *node]
    with Observer() as observer:
        process = subprocess.Popen(
            command, env=domain_environment(observer.domain), stdout=subprocess.PIPE, text=True
        )
        try:
            observer.wait_for_answers("scanner")
            process.send_signal(signal.SIGINT)
            printed, _ = process.communicate(timeout=20.0)
        finally:
            process.kill()
    assert printed.splitlines()[-1] == "left:"


def test_all_nodes_in_one_process_scan_and_end(tmp_path: Path) -> None:
    log, domain, file = tmp_path / "output.log", free_domain(), tmp_path / "lab.yaml"
    with remote_bench(**scenarios.bench_settings(log)) as (_, folder):
        tables = {
            f"{NAMESPACE}/{node_name(module)}": {
                "ros__parameters": {key: str(value) for key, value in table.items()}
            }
            for module, table in scenarios.node_parameters(folder).items()
        }
        file.write_text(yaml.safe_dump(tables))
        module = "eschorty_ros.nodes.one_process.instrument"
        with NodeProcess(module, {}, domain=domain, file=file) as process:
            with scenarios.bench(domain, log) as bench:
                scenarios.full_scan(bench)
            assert_ctrl_c_ends({"instrument": process})


def test_a_terminal_that_is_gone_keeps_no_node_from_its_safe_state(monkeypatch) -> None:
    class Gone(io.StringIO):
        def write(self, _: str) -> int:
            raise OSError(errno.EIO, "Input/output error")

    class Unsafe:
        def get_name(self) -> str:
            return "camera"

        def safe_state(self) -> None:
            asked.append(self)
            raise DeviceError("no answer")

    asked: list[Unsafe] = []
    nodes = [Unsafe(), Unsafe()]
    monkeypatch.setattr(sys, "stderr", Gone())
    make_safe(nodes)
    assert asked == nodes


def test_a_signal_with_a_handler_of_its_own_costs_nothing() -> None:
    """SIGUSR1, after which the node goes on."""
    with Observer() as observer:
        beats = observer.collect(Header, "laser/heartbeat", qos.heartbeat())
        topics = {"topics": "laser/heartbeat"}
        with NodeProcess("heartbeat_sender", topics, domain=observer.domain) as node:
            wait_until(lambda: beats, "a heartbeat")
            node.send(signal.SIGUSR1)
            used_s = cpu_s(node.pid)
            time.sleep(2.0)
            assert cpu_s(node.pid) - used_s < 1.0


def cpu_s(pid: int) -> float:
    """Processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
