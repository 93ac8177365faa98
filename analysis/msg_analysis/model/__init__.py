"""What an experiment is, and what one step and one run of it are.

No predictions, files of runs or statistics. The folders, lowest first: network, arithmetic, experiment, step, run.
"""
