"""``python -m msg_analysis`` is ``msg-analysis``."""

from msg_analysis.cli.main import main

if __name__ == "__main__":
    main(prog_name="msg-analysis")
