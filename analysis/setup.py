from setuptools import find_packages, setup

PACKAGE = "msg_analysis"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Theory, bags and statistics of networks of agents under Markov-switching graphs, free of ROS",
    license="Apache-2.0",
    author="The msg_agents authors",
    maintainer="The msg_agents authors",
    maintainer_email="maintainers@msg-agents.example.org",
    python_requires=">=3.11",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={
        PACKAGE: ["py.typed", "report/templates/*", "bags/definitions/*/msg/*.msg"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    zip_safe=False,
    install_requires=[
        "click",
        "jinja2",
        "matplotlib",
        "mcap",
        "networkx",
        "numpy",
        "pydantic>=2",
        "pyyaml",
        "rich",
        "scipy",
        "threadpoolctl",
        "zstandard",
    ],
    entry_points={"console_scripts": ["msg-analysis = msg_analysis.cli:main"]},
)
