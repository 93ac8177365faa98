"""The experiment and one step of it: file, graphs, chain, noise, update law, run record and trajectory.

This folder imports no other folder of msg_analysis; all others may import it.
"""
