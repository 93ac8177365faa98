# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""RCLError, the error of rclpy's C layer, wherever this version of rclpy has it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.node import Node

try:
    from rclpy._rclpy_pybind11 import RCLError
except ImportError:  # rclpy of other distributions
    from rclpy.impl.implementation_singleton import rclpy_implementation

    RCLError = rclpy_implementation.RCLError

__all__ = ["RCLError", "until_shutdown"]


@contextmanager
def until_shutdown(node: Node) -> Iterator[None]:
    """Drop what cannot be published any more: a signal has shut rclpy down in the middle of a callback.

    The executor would print the error as FATAL, with a stack.
    """
    try:
        yield
    except RCLError:
        if node.context.ok():
            raise
