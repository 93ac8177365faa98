"""The files of a bag, whatever the messages are: MCAP, metadata.yaml, counts, storage options.

Nothing here decodes a message. Imports only the package's ``errors``, ``types`` and ``common``.
"""
