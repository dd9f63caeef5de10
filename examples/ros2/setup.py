"""Build of the ROS 2 package: `colcon build --packages-select companion_bridge`."""

from setuptools import setup

setup(
    name="companion_bridge",
    version="1.0.0",
    packages=["companion_bridge"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/companion_bridge"]),
        ("share/companion_bridge", ["package.xml"]),
    ],
    install_requires=["uav-companion-beams"],
    zip_safe=True,
    entry_points={"console_scripts": ["bridge = companion_bridge.bridge:main"]},
)
