"""Installed entry point: the command line."""

from __future__ import annotations

import sys


def msg_analysis() -> None:
    """The command line ``msg-analysis``."""
    try:
        from msg_analysis.cli.main import main
    except KeyboardInterrupt:  # the command group handles it only after these imports
        from msg_analysis.common.exit_codes import INTERRUPTED

        sys.exit(INTERRUPTED)
    main(prog_name="msg-analysis")
