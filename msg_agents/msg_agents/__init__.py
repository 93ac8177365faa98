"""Networks of agents under Markov-switching graphs, as ROS 2 nodes."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("msg_agents")
except PackageNotFoundError:  # run from a source tree that nobody installed
    __version__ = "0.0.0"
