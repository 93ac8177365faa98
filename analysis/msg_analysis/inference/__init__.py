# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Whether a run follows the predicted model, and what is wrong if it does not."""
