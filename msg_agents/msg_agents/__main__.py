# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""``python -m msg_agents`` is ``msg-agents``."""

from __future__ import annotations

from msg_agents.cli.entry_points import msg_agents

if __name__ == "__main__":
    msg_agents()
