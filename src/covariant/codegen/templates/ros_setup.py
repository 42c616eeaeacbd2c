"""Build of the package, by colcon or pip."""

from setuptools import setup

PACKAGE = "xPACKAGEx"

setup(
    name=PACKAGE,
    version="1.0.0",
    packages=[PACKAGE, "xNAMEx"],
    package_data={"xNAMEx": ["*.so", "*.dylib", "*.dll", "*.c", "*.h"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", ["launch/xNAMEx.launch.py"]),
        (f"share/{PACKAGE}/config", ["config/xNAMEx.yaml"]),
    ],
    install_requires=["setuptools", "numpy"],
    zip_safe=False,
    entry_points={"console_scripts": [f"observer = {PACKAGE}.node:main"]},
)
