"""Builds the package with colcon (ament_python)."""

from setuptools import setup

NAME = "r3jax_ros"

setup(
    name=NAME,
    version="0.1.0",
    description="Where a robot should look next for 3D Gaussian splatting: r3jax as a ROS 2 node",
    license="MIT",
    maintainer="r3jax contributors",
    maintainer_email="r3jax@users.noreply.github.com",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", ["config/r3jax.yaml"]),
        (f"share/{NAME}/launch", ["launch/r3jax.launch.py"]),
        (f"share/{NAME}/rviz", ["rviz/r3jax.rviz"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"console_scripts": [f"explorer = {NAME}.main:main"]},
)
