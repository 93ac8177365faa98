"""Results for people: documents, text in a terminal, figures, and a report in a browser.

Nothing is computed here that a script would need. The folders, lowest first: documents, figures, terminal, html.
"""
