"""Results for people and scripts: terminal tables, the HTML report, figures, and the documents of ``--json``."""
