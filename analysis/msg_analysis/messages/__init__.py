# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Messages as bytes: CDR, topics, and which messages a receiver accepts."""
