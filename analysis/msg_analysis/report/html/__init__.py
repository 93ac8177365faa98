"""The report: one HTML file with interactive figures.

May import the other folders of report and what is below them.
"""
