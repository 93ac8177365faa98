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

"""Errors caused by the user's input; all commands catch the base class in one place."""


class InputError(Exception):
    """Bad input. The message names the key or file, the value, what was expected and what to do. Exit code 2."""


class NotAvailableError(InputError):
    """Something that the file format or the library has, but that is not there for this experiment."""


class BagError(InputError):
    """A bag that cannot be read or written, or that does not hold one run of a network."""
