# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The experiment file: graphs, Markov chain, keys, checks, and the experiment itself."""
