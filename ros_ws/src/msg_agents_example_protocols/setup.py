# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "msg_agents_example_protocols"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Examples of protocols for msg_agents: Metropolis weights, saturated coupling, integral action",
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
    package_data={PACKAGE: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/experiments", sorted(map(str, Path("experiments").glob("*.yaml")))),
    ],
    zip_safe=False,
    install_requires=["msg_analysis", "numpy", "pydantic>=2"],
    extras_require={"test": ["pytest"]},  # by which colcon knows how to test it
    # This is all that makes a class a protocol: the name on the left is the one that experiments use.
    entry_points={
        "msg_agents.protocols": [
            f"metropolis = {PACKAGE}.metropolis:Metropolis",
            f"saturated = {PACKAGE}.saturated:Saturated",
            f"integral_action = {PACKAGE}.integral_action:IntegralAction",
        ]
    },
)
