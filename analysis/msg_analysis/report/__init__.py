"""Results for people: tables in a terminal, and a report in a browser."""
