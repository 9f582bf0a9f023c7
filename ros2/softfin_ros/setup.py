"""Installs the nodes, launch files, parameters and robot description where ROS 2 looks for them."""

from pathlib import Path

from setuptools import setup

NAME = "softfin_ros"


def files(pattern: str) -> list[str]:
    """Return the files of this folder that match a pattern."""
    return sorted(str(path) for path in Path().glob(pattern))


setup(
    name=NAME,
    version="1.0.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", files("launch/*.launch.py")),
        (f"share/{NAME}/config", files("config/*.yaml")),
        (f"share/{NAME}/urdf", files("urdf/*.xacro")),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="softfin contributors",
    maintainer_email="nobody@example.com",
    description="ROS 2 nodes of softfin, which make a soft fin produce the force you ask for.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": ["fin = softfin_ros.fin:main", "robot = softfin_ros.robot:main"]
    },
)
