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

"""The end of a process at a set time, with exit code 0, also when Python cannot run any more."""

from __future__ import annotations

import contextlib
import ctypes
import sys
import time

SIGEV_THREAD = 2  # of <signal.h>: the C library calls a function in a thread of its own


class _Event(ctypes.Structure):
    """``struct sigevent`` of Linux, 64 bytes."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("padding", ctypes.c_byte * 32),
    )


def exit_after(seconds: int) -> None:
    """End this process with exit code 0 in so many seconds, unless it has ended by then.

    Neither the interpreter's lock nor the interpreter is needed. C libraries without such timers do nothing.
    """
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "timer_create"):
        return
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):  # there is none, or nobody reads it any more
            stream.flush()
    function = ctypes.cast(library._exit, ctypes.c_void_p)
    event = _Event(notify=SIGEV_THREAD, function=function.value)  # its value, 0, is what _exit is called with
    timer = ctypes.c_void_p()
    in_time = (ctypes.c_long * 4)(0, 0, seconds, 0)  # interval and time to the end, each in s and ns
    if library.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0:
        library.timer_settime(timer, 0, in_time, None)
