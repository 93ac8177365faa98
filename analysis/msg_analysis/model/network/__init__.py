"""The weighted graphs of a network and the Markov chain that switches between them.

How a file describes them belongs to ``model.experiment``. Imports only the package's ``types`` and ``common``.
"""
