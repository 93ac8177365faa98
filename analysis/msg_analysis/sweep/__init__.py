"""Sweeps: one experiment at many values of its keys; the sweep file, the plan, the results.

What a worker does belongs to ``sweep.jobs``. May import sweep.jobs, inference and what is below it.
"""
