"""Where this rclpy keeps the error that its C layer raises."""

try:
    from rclpy._rclpy_pybind11 import RCLError
except ImportError:  # rclpy of other distributions
    from rclpy.impl.implementation_singleton import rclpy_implementation

    RCLError = rclpy_implementation.RCLError

__all__ = ["RCLError"]
