# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The offline twin: runs without ROS, and the check that a network made the same states."""
