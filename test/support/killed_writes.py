"""Kill commands at each step that they take with files, and let their disk be full at many sizes.

``python killed_writes.py FOLDER``: exit code 0 when no run left a truncated file, and the run after
it nothing temporary.
"""

import json
import os
import resource
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

from click.testing import CliRunner

from eschorty_ros.cli import main
from eschorty_ros.core.optics import load_calibration, save_calibration
from eschorty_ros.core.storage import read_cloud
from eschorty_ros.nodes.one_process import scan as one_scan
from eschorty_ros.report import calibration_page, figures

STEPS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree"}
TOP = ("rec", "new", "scanned", "calibration", ".")
FULL_AT = (0, 1, 100, 1000, 5000, 20_000, 100_000)
SWEEP = ("--scene", "plane", "--start", 10, "--stop", 11, "--speed", 50)
TARGETS = "row,range_mm\n50,820\n100,860\n300,1064\n500,1395\n600,1620\n"
COMMANDS = {
    "simulate": ("simulate", *SWEEP, "--calibration", "small.yaml", "--out", "new"),
    "reconstruct": ("reconstruct", "rec"),
    "calibrate": ("calibrate", "targets.csv", "--out", "calibration.yaml"),
    "scan": ("scan", *SWEEP, "--calibration", "small.yaml", "--out", "scanned"),
}


def prepare(folder):
    """Files that the commands take and those of an earlier run; all kernels are compiled."""
    folder.mkdir()
    os.chdir(folder)
    small = replace(load_calibration("config_3"), columns=24, principal_column=None)
    save_calibration(small, "small.yaml")
    Path("targets.csv").write_text(TARGETS)
    for out, stop in (("rec", 12), ("again", 13)):
        done = run("simulate", "--scene", "plane", "--start", 10, "--stop", stop, "--speed", 200,
                   "--calibration", "small.yaml", "--out", out)  # fmt: skip
        assert done[0] == 0, done
        assert run("reconstruct", out)[0] == 0
    points = read_cloud("again/cloud.pcd")
    result = SimpleNamespace(
        success=True, message="", points=points, profiles=9, events=9, events_dropped=0,
        packets_lost=0, verdict="complete", completeness=1.0, recording="",
        organized=None,
    )  # fmt: skip
    one_scan.scan_once = lambda *_: result
    # Drawing takes long and touches no file.
    figures.scan_figure = lambda *_, **__: figures.new_figure(1.0, 1.0)
    calibration_page.calibration_html = lambda *_: "<html></html>" * 1000
    for name in ("calibrate", "scan"):
        done = run(*COMMANDS[name])
        assert done[0] == 0, done
    # What an earlier run left differs in size.
    Path("rec/cloud.pcd").write_bytes(Path("again/cloud.pcd").read_bytes())
    for old in ("calibration.yaml", "calibration.html", "scanned/scan.png"):
        Path(old).write_text("old")


def run(*arguments):
    done = CliRunner().invoke(main, [str(argument) for argument in arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stderr


def in_a_child(arguments, before=lambda: None):
    """Exit code and stderr of the command, ``None`` when it was killed."""
    sys.stdout.flush()
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        before()
        try:
            text = json.dumps(run(*arguments))
        except BaseException as error:
            text = json.dumps(["traceback", repr(error)])
        os.write(write, text.encode())
        os._exit(0)
    os.close(write)
    with open(read, "rb") as stream:
        text = stream.read()
    os.waitpid(child, 0)
    return json.loads(text) if text else None


def kill_at(step, folder):
    left = step

    def hook(event, arguments):
        nonlocal left
        reading = event == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR)
        ours = str(arguments[0]).startswith((str(folder), *TOP)) if arguments else False
        if event not in STEPS or reading or not ours:
            return
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)

    return lambda: sys.addaudithook(hook)


def sizes():
    return {
        str(path): path.stat().st_size
        for path in Path().rglob("*")
        if path.is_file() and "eschorty-partial" not in str(path)
    }


def temporary():
    return [str(path) for path in Path().rglob("*eschorty-partial*")]


def main_test(command, base):
    arguments = COMMANDS[command]
    work = base / "work"

    def fresh():
        os.chdir(base)
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(base / "prepared", work)
        os.chdir(work)

    fresh()
    before = sizes()
    done = in_a_child(arguments)
    assert done[0] == 0, done
    after = sizes()
    made = [name for name in after if after[name] != before.get(name)]
    assert made, after

    def check(what):
        found = sizes()
        for name, size in found.items():
            assert size in (before.get(name), after.get(name)), f"{what}: {name} has {size} bytes"
        if command == "simulate" and any(name.startswith("new/") for name in found):
            code, line = run("info", "new")
            assert code == 0 or "missing from the recording" in line, f"{what}: {line}"
        again = in_a_child(arguments)
        refused = command == "simulate" and any(name.startswith("new/") for name in found)
        assert again[0] == int(refused), f"{what}, next run: {again}"
        assert refused or sizes() == after, what
        assert temporary() == [], what

    step = 0
    while True:
        fresh()
        done = in_a_child(arguments, kill_at(step, work))
        if done is not None:
            assert done[0] == 0, done
            break
        check(f"killed at step {step}")
        step += 1
    print(f"{command}: killed at {step} steps")
    assert step > 3
    full = 0
    for limit in FULL_AT:
        fresh()
        bounds = (limit, resource.RLIM_INFINITY)
        code, stderr = in_a_child(
            arguments, lambda bounds=bounds: resource.setrlimit(resource.RLIMIT_FSIZE, bounds)
        )
        assert temporary() == [], f"full at {limit}"
        if code == 0:
            assert sizes() == after
            continue
        full += 1
        assert code == 1, f"full at {limit}: {code} {stderr}"
        assert "File too large" in stderr, stderr
        assert stderr.count("eschorty: ") == 1, stderr
        check(f"full at {limit}")
    print(f"{command}: disk full in {full} of {len(FULL_AT)} runs")
    assert full > 1


if __name__ == "__main__":
    base = Path(sys.argv[1])
    prepare(base / "prepared")
    for command in COMMANDS:
        main_test(command, base)
