"""Second moments of jump linear systems: reduced systems, equations and solvers, predictions, transients, leaders.

Imports ``model`` and the small modules of ``msg_analysis`` (errors, types, markdown), never bags, inference or reports.
"""
