# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""``python -m msg_analysis`` is ``msg-analysis``."""

from __future__ import annotations

from msg_analysis.cli.entry_point import msg_analysis

if __name__ == "__main__":
    msg_analysis()
