# SPDX-License-Identifier: BSD-3-Clause
"""For catkin alone, which reads it at configure time and runs it at install time: build with CMake."""

from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import find_packages, setup

setup(**generate_distutils_setup(packages=find_packages("src"), package_dir={"": "src"}))
