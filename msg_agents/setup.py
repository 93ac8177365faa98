# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

import sys

from setuptools import find_packages, setup

PACKAGE = "msg_agents"
NODES = ("agent", "switcher", "recorder", "player", "live", "markers", "external")
# A wheel puts executables into the user's PATH, where only the command line belongs; colcon and distributions put them
# into lib/msg_agents (setup.cfg), where `ros2 run` and `ros2 launch` find them, and the command line into bin, too.
WHEEL = {"bdist_wheel", "editable_wheel", "dist_info"} & set(sys.argv)

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Networks of agents under Markov-switching graphs, as ROS 2 nodes",
    license="Apache-2.0",
    author="msg_agents maintainers",
    maintainer="msg_agents maintainers",
    maintainer_email="maintainers@msg-agents.example.org",
    classifiers=[
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    python_requires=">=3.11",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed", "discovery/*.xml", "discovery/fast_dds_3/*.xml", "watch/pages/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *([] if WHEEL else [("bin", ["bin/msg-agents"])]),
    ],
    zip_safe=False,
    # rclpy, std_msgs and the interfaces come with ROS 2, as system packages or as wheels: see package.xml.
    install_requires=["click", "msg_analysis", "numpy", "rich", "setproctitle", "threadpoolctl"],
    extras_require={"test": ["pytest"]},  # by which colcon knows how to test it
    entry_points={
        "console_scripts": [
            "msg-agents = msg_agents.cli.entry_points:msg_agents",
            *(f"{node} = msg_agents.cli.entry_points:{node}" for node in (() if WHEEL else NODES)),
        ],
        "ros2cli.command": ["msg-agents = msg_agents.cli.entry_points:Verb"],
    },
)
