# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Results that are equal to the last bit on every machine: update law, random streams, step times."""
