"""RCLError, the error of rclpy's C layer, wherever this version of rclpy has it."""

try:
    from rclpy._rclpy_pybind11 import RCLError
except ImportError:  # rclpy of other distributions
    from rclpy.impl.implementation_singleton import rclpy_implementation

    RCLError = rclpy_implementation.RCLError

__all__ = ["RCLError"]
