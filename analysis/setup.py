# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

import os
import sys

from setuptools import Extension, find_packages, setup

PACKAGE = "msg_analysis"
# A wheel puts executables into the user's PATH; colcon and distributions put them into lib/msg_analysis (setup.cfg),
# where `ros2 run` finds them, and the command line into bin, too.
WHEEL = {"bdist_wheel", "editable_wheel", "dist_info"} & set(sys.argv)

# Without a compiler the package works all the same, only slower. Fused multiply-adds would change the last bits.
KERNEL = Extension(
    f"{PACKAGE}.arithmetic._kernel",
    [f"{PACKAGE}/arithmetic/_kernel.c"],
    extra_compile_args=["-O2", "-ffp-contract=off"] if os.name == "posix" else [],
    optional=True,
)

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Theory, bags and statistics of networks of agents under Markov-switching graphs, free of ROS",
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
    ext_modules=[KERNEL],
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={
        PACKAGE: [
            "py.typed",
            "experiment/bundled/*.yaml",
            "experiment/bundled/*.csv",
            "arithmetic/_kernel.pyi",
            "report/templates/*",
            "messages/definitions/*/msg/*.msg",
        ],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *([] if WHEEL else [("bin", ["bin/msg-analysis"])]),
    ],
    zip_safe=False,
    install_requires=[  # least versions as in requirements/least.txt
        "bokeh",
        "click>=8.1.6",
        "dask",
        "distributed",
        "jinja2>=3.1.2",
        "markupsafe",
        "matplotlib>=3.6.3",
        "mcap",
        "networkx>=2.8.8",
        "numpy>=1.26.4",
        "pyarrow>=17.0.0",
        "pydantic>=2",
        "pyyaml>=6.0.1",
        "rich>=13.7.1",
        "scipy>=1.11.4",
        "threadpoolctl",
        "lz4",
        "zstandard",
    ],
    extras_require={
        "pandas": ["pandas"],  # run.to_dataframe()
        "robots": ["rosbags"],  # msg-analysis map, compare --map of a bag
        "rerun": ["rerun-sdk"],  # msg-analysis export --rrd
        "test": ["pytest"],  # by which colcon knows how to test it
    },
    entry_points={
        "console_scripts": ["msg-analysis = msg_analysis.cli.entry_point:msg_analysis"],
        "pytest11": ["msg_analysis = msg_analysis.pytest_plugin"],
    },
)
