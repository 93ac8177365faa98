# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Predictions: moments of Markov jump linear systems, spectra, leaders, graph indices."""
