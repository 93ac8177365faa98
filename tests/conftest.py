"""What holds for every test."""

from __future__ import annotations

import signal

from hypothesis import settings

# No test asserts a time: on a busy machine any example may be slow.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

# A shell script has what it starts in the background ignore Ctrl-C, and so would all that the tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
