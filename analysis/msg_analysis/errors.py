"""What can go wrong through the user's input: one base class, so that every command has one place to catch it."""


class InputError(Exception):
    """Bad input. The text names the key or file, the value, what was expected and what to do. Exit code 2."""


class NotAvailableError(InputError):
    """The file asks for something that the format has but this version does not do yet."""


class BagError(InputError):
    """A bag that cannot be written, or a file that is no bag of this network."""
