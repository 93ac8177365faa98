# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Real links between agents: network namespaces and forwarded datagrams."""
