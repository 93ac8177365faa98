# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Foreign text for terminals: names in files of strangers may hold the escape sequences that terminals obey."""

from __future__ import annotations

_ORDER = {*range(0x202A, 0x202F), *range(0x2066, 0x206A)}  # characters that change the order of those after them
_SHOWN = {
    code: f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
    for code in [*range(0x20), *range(0x7F, 0xA0), *_ORDER]
    if chr(code) not in "\n\t"
}


def visible(text: str) -> str:
    """The text with its control characters written as escapes; line ends and tabs stay."""
    return text.translate(_SHOWN)
