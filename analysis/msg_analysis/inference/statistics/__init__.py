"""Statistical methods that know nothing of networks: Holm, batch means, covariance tests, forward selection.

Imports only the package's ``types``.
"""
