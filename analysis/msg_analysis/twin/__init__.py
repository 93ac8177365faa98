"""The offline twin: a run without ROS, and the comparison of a bag with it to the last bit.

Statistics belong to ``inference``. May import model and theory.
"""
