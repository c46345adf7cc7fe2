"""Builds the package with colcon."""

from setuptools import setup

setup(
    name="dimos_ros2",
    version="0.1.0",
    packages=["dimos_ros2"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/dimos_ros2"]),
        ("share/dimos_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    license="Apache-2.0",
    entry_points={"console_scripts": ["node = dimos_ros2.node:main"]},
)
