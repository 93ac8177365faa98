"""Errors caused by the user's input; all commands catch the base class in one place."""


class InputError(Exception):
    """Bad input. The message names the key or file, the value, what was expected and what to do. Exit code 2."""


class NotAvailableError(InputError):
    """Something that the file format or the library has, but that is not there for this experiment."""


class BagError(InputError):
    """A bag that cannot be read or written, or that does not hold one run of a network."""
