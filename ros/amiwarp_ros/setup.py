"""Build of the package, as ``ament_python`` expects it."""

from glob import glob

from setuptools import setup

NAME = "amiwarp_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
    ],
    install_requires=["setuptools", "amiwarp"],
    zip_safe=True,
    license="MIT",
    entry_points={
        "console_scripts": [
            f"compensate = {NAME}.compensate_node:main",
            f"pictures = {NAME}.pictures_node:main",
            f"filter = {NAME}.filter_node:main",
        ],
    },
)
