"""Numbers, names and tables as text, for terminals and files."""
