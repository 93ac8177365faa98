"""Small helpers that any folder may use: whole files, tables for notebooks, numbers as words, the version.

Nothing about networks or runs belongs here. Imports only the modules ``errors`` and ``types`` of the package.
"""
