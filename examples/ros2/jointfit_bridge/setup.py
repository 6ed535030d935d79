"""Configuration of the installation with colcon."""

from setuptools import setup

NAME = "jointfit_bridge"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    install_requires=["setuptools", "paho-mqtt"],
    description="Joint angles and segment orientations of jointfitd for ROS 2.",
    license="MIT",
    entry_points={"console_scripts": ["bridge = jointfit_bridge.node:main"]},
)
