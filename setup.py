"""Python metadata: `pip install .` gives the ROS-free part and the `eschorty` command."""

from pathlib import Path

from setuptools import find_packages, setup

HERE = Path(__file__).parent
REQUIREMENTS = [
    line
    for line in (HERE / "requirements" / "run.txt").read_text().splitlines()
    if line and not line.startswith("#")
]

setup(
    name="eschorty_ros",
    version="0.1.0",
    description="Event-based Scheimpflug LiDAR: events and stage motion in, point cloud out",
    long_description=(HERE / "README.md").read_text(),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="eschorty_ros maintainers",
    maintainer_email="maintainers@eschorty.org",
    classifiers=[
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Programming Language :: Python :: 3.13",
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    python_requires=">=3.11",
    packages=find_packages(include=["eschorty_ros", "eschorty_ros.*"]),
    package_data={"eschorty_ros": ["*.pyi", "py.typed"], "eschorty_ros.report": ["*.jinja"]},
    data_files=[
        (
            "share/eschorty_ros/config",
            sorted(
                str(path.relative_to(HERE))
                for path in HERE.glob("config/*")
                if path.suffix in (".csv", ".rules", ".xml", ".yaml")
            ),
        )
    ],
    install_requires=REQUIREMENTS,
    extras_require={
        # Apache-2.0: rosbag2 files without ROS, for `eschorty convert` and `reconstruct BAG`.
        "bags": ["rosbags>=0.11"],
        "mesh": ["open3d>=0.19", "libusb-package"],
        "viewer": ["viser>=1.1"],
        "cluster": ["distributed"],
        # LGPL: several transfers in flight; without it the camera is read one transfer at a time.
        "usb-async": ["libusb1>=3.1"],
        "usb-library": ["libusb-package"],
    },
    entry_points={
        "console_scripts": [
            "eschorty = eschorty_ros.cli:main",
            "eschorty-bench = eschorty_ros.emulation.bench.server:main",
        ]
    },
)
