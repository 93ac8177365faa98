"""Small helpers that any folder may use: exit codes, files, text, the version.

Nothing about networks or runs belongs here. Imports only the modules ``errors`` and ``types`` of the package.
"""
