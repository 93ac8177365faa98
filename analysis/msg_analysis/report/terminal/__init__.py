"""Results as text and tables for a terminal.

May import report.documents and what is below report.
"""
