"""What the package promises to other ROS 2 software and to those who install it."""

import ast
import importlib
import json
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib.util import find_spec
from pathlib import Path
from zipfile import ZipFile

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
        sources, built = (
            {path.name: path.read_text() for path in (folder / kind).glob(f"*.{kind}")}
            for folder in (ROOT, share)
        )
        assert sources
        changed = [name for name in sources | built if sources.get(name) != built.get(name)]
        assert not changed, f"{', '.join(changed)}: not built as in the sources; run: make setup"


def test_installed_layout() -> None:
    share = _share("eschorty_ros")
    prefix = share.parents[1]
    for folder in ("config", "launch"):
        names = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        assert names <= {path.name for path in (share / folder).iterdir()}, "run: make setup"
    for script in (*(prefix / "lib" / "eschorty_ros").iterdir(), prefix / "bin" / "eschorty"):
        assert os.access(script, os.X_OK)


def test_both_lists_of_python_packages_are_the_same() -> None:
    keys = {"pyserial": "serial", "pyusb": "usb", "pyyaml": "yaml"}
    lines = (ROOT / "requirements" / "run.txt").read_text().splitlines()
    names = [line.partition(">")[0] for line in lines if line and not line.startswith("#")]
    needed = {element.text for element in ElementTree.parse(ROOT / "package.xml").iter()}
    assert names
    assert {f"python3-{keys.get(name, name)}" for name in names} <= needed


def test_the_package_names_what_its_nodes_and_launch_files_import_of_ros() -> None:
    ours = {"ament_index_python", "launch", "launch_ros", "rclpy"}
    imported = set()
    for script in (*ROOT.glob("eschorty_ros/**/*.py"), *ROOT.glob("launch/*.py")):
        for node in ast.walk(ast.parse(script.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            imported |= {name.partition(".")[0] for name in names}
    messages = {name for name in imported if name.endswith(("_msgs", "_srvs", "_interfaces"))}
    needed = {element.text for element in ElementTree.parse(ROOT / "package.xml").iter()}
    assert ours <= imported
    assert (ours | messages) - needed == set()


def test_the_oldest_versions_are_those_that_are_tested() -> None:
    bounds, pins = (
        {line.replace(">=", "==") for line in (ROOT / "requirements" / name).read_text().split()}
        for name in ("run.txt", "floor.txt")
    )
    wanted = {line for line in bounds if "==" in line}
    # matplotlib's own, which has no upper bound for it.
    assert wanted | {"pyparsing==3.1.1"} == {line for line in pins if "==" in line}


@pytest.mark.parametrize("name", ["event_camera_msgs", "tf2_msgs"])
def test_message_packages_build_in_a_workspace_of_their_own(tmp_path: Path, name: str) -> None:
    package = tmp_path / name
    shutil.copytree(ROOT / "external_msgs" / name, package)
    own = (ROOT / "cmake" / "usable_imports.cmake").read_text()
    assert (package / "cmake" / "usable_imports.cmake").read_text() == own
    prefix = os.environ["AMENT_PREFIX_PATH"].replace(os.pathsep, ";")
    done = subprocess.run(
        ["cmake", "-S", package, "-B", tmp_path / "build", "-DBUILD_TESTING=OFF",
         f"-DCMAKE_PREFIX_PATH={prefix}", f"-DPython3_EXECUTABLE={sys.executable}"],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]


def _built(source: Path, kind: str) -> Path:
    """Build as pip does and return the one file."""
    code = f"from setuptools import build_meta; build_meta.build_{kind}('made')"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True)
    [built] = (source / "made").glob({"sdist": "*.tar.gz", "wheel": "*.whl"}[kind])
    return built


def test_wheels_of_the_checkout_and_of_the_source_archive_are_the_same(tmp_path: Path) -> None:
    tree = tmp_path / "tree"
    unwanted = shutil.ignore_patterns(".*", "build", "dist", "__pycache__", "*.egg-info")
    shutil.copytree(ROOT, tree, ignore=unwanted)
    archive = _built(tree, "sdist")
    subprocess.run(["tar", "-xzf", archive, "-C", tmp_path], check=True)
    unpacked = tmp_path / archive.name.removesuffix(".tar.gz")
    assert not (unpacked / "test").exists()
    wheels = [_built(source, "wheel") for source in (unpacked, tree)]
    contents = []
    for wheel in wheels:
        with ZipFile(wheel) as packed:
            contents.append({name: packed.read(name) for name in packed.namelist()})
    assert contents[0] == contents[1]
    metadata = next(contents[0][name] for name in contents[0] if "METADATA" in name).decode()
    assert "file:" not in metadata
    maintainer = ElementTree.parse(ROOT / "package.xml").find("maintainer")
    assert maintainer is not None
    assert f"Maintainer: {maintainer.text}" in metadata
    assert f"Maintainer-email: {maintainer.get('email')}" in metadata
    sources = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "eschorty_ros").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert sources == {name for name in contents[0] if name.startswith("eschorty_ros/")}


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


@pytest.mark.parametrize(
    ("command", "target"),
    [("scan", "scan"), ("calibrate --fake", "setup"), ("view --live", "setup")],
)
def test_commands_that_need_ros_name_the_make_target(command: str, target: str) -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None; "
        f"from eschorty_ros.cli import main; main({command.split()})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, cwd=ROOT
    )
    assert done.returncode == 1
    [line] = done.stderr.splitlines()
    assert f"run `make {target}`, or source a ROS 2 installation" in line


def test_scripts_import_names_that_exist() -> None:
    """Benchmarks and the pages' scripts run by hand."""
    missing = []
    for script in (*ROOT.glob("benchmark/*.py"), *ROOT.glob("docs/*.py")):
        for node in ast.walk(ast.parse(script.read_text())):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("eschorty_"):
                module = importlib.import_module(str(node.module))
                for name in (alias.name for alias in node.names):
                    package = hasattr(module, "__path__")
                    known = package and find_spec(f"{node.module}.{name}") is not None
                    if not known and not hasattr(module, name):
                        missing.append(f"{script.name}: {node.module}.{name}")
    assert missing == []


def test_the_public_names_are_there_and_come_on_first_use() -> None:
    code = (
        "import sys, eschorty_ros as es\n"
        "assert not {'numpy', 'numba'} & set(sys.modules)\n"
        "assert set(es.__all__) <= set(dir(es))\n"
        "assert all(getattr(es, name) is not None for name in es.__all__)\n"
        "assert not hasattr(es, 'nonsense')"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300, cwd=ROOT)


def test_type_checkers_know_every_public_name(tmp_path: Path) -> None:
    """An editor completes what they know."""
    import eschorty_ros as es

    script = tmp_path / "of_a_user.py"
    shown = "".join(f"reveal_type(es.{name})\n" for name in es.__all__)
    script.write_text(f"import eschorty_ros as es\n{shown}es.reconstruct('rec').nonsense\n")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", f"--cache-dir={tmp_path}", script],
        capture_output=True, text=True, timeout=300, cwd=tmp_path,
        env=os.environ | {"MYPYPATH": str(ROOT)},
    )  # fmt: skip
    assert done.stdout.count("Revealed type") == len(es.__all__), done.stdout
    assert '"Any"' not in done.stdout
    [error] = [line for line in done.stdout.splitlines() if "error:" in line]
    assert '"Cloud" has no attribute "nonsense"' in error
