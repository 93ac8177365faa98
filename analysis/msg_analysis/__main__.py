"""``python -m msg_analysis`` is ``msg-analysis``."""

from msg_analysis.cli.entry_point import msg_analysis

if __name__ == "__main__":
    msg_analysis()
