# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Types of arrays, and arrays that may be larger than the memory."""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from msg_analysis.errors import InputError

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
AnyArray = NDArray[Any]


def once(stack: FloatArray) -> FloatArray:
    """The first of the arrays in a stack, as a stack, where all are the same array (``numpy.broadcast_to``)."""
    return stack if stack.strides[0] else stack[:1]


LARGE = 2**27  # bytes from which an array is in a file,
LARGE_VARIABLE = "MSG_ANALYSIS_LARGE"  # unless this environment variable has another number of bytes
BLOCK_NUMBERS = 2_000_000  # numbers of a large array that are processed together: 16 MB
SMALL_BLOCK = 200_000  # the same where there are several such arrays: they stay in the caches, and memory is used again


def _large() -> int:
    value = os.environ.get(LARGE_VARIABLE) or str(LARGE)
    try:
        return int(value)
    except ValueError:
        wanted = f"expected a number of bytes: unset it, or give {LARGE} for example"
        raise InputError(f"{LARGE_VARIABLE}: {value}: {wanted}") from None


def large_zeros(shape: tuple[int, ...], dtype: Any, *, total: int) -> AnyArray:
    """Zeros, in a file if so many bytes belong together (``total``) and it has room; MemoryError or ValueError."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if total >= _large() and size and hasattr(os, "posix_fallocate"):
        with suppress(OSError), tempfile.TemporaryFile(prefix="msg_analysis.") as file:
            os.posix_fallocate(file.fileno(), 0, size)  # a write to a full disk would end the process
            return np.memmap(file, dtype=dtype, mode="r+", shape=shape)
    return np.zeros(shape, dtype)


class LargeRows:
    """Rows that are found one part after the other: in a file from some number of bytes on, if there is room for it."""

    def __init__(self, columns: int, dtype: Any, in_memory: int | None = None) -> None:
        self._shape, self._dtype = (-1, columns), np.dtype(dtype)
        self._parts: list[AnyArray] = []
        self._in_memory = _large() // 8 if in_memory is None else in_memory  # bytes, at most
        self._held = self._written = 0  # bytes
        self._file: IO[bytes] | None = None

    def append(self, rows: AnyArray) -> int:
        """Add rows; the number of those before."""
        part = np.ascontiguousarray(rows, self._dtype)
        before: int = (self._held + self._written) // (self._shape[1] * self._dtype.itemsize)
        self._parts.append(part)
        self._held += part.nbytes
        if self._held + self._written >= self._in_memory:
            self._move()
        return before

    def array(self) -> AnyArray:
        """(rows, columns), when all have been added: read-only where it is in a file."""
        in_memory = np.concatenate([np.empty((0, self._shape[1]), self._dtype), *self._parts])
        if self._file is None:
            return in_memory
        with self._file as file:
            if not self._written:
                return in_memory
            written = np.memmap(file, dtype=self._dtype, mode="r", shape=(self._written // self._dtype.itemsize,))
        rows: AnyArray = written.reshape(self._shape)
        return np.concatenate([rows, in_memory]) if len(in_memory) else rows

    def _move(self) -> None:
        """Into the file; they stay in memory where the disk is full."""
        with suppress(OSError):
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="msg_analysis.", buffering=0)  # noqa: SIM115  until `array`
            while self._parts:
                self._file.seek(self._written)
                left = memoryview(self._parts[0].tobytes())
                while left:
                    left = left[self._file.write(left) :]
                self._written += self._parts[0].nbytes
                self._held -= self._parts.pop(0).nbytes


def in_file(array: AnyArray) -> bool:
    """Whether the array, or that of which it is a view, is in a file."""
    return _mapping(array) is not None


def release(array: AnyArray) -> None:
    """Give the memory of an array in a file back to the system: it is read again when it is needed."""
    mapping = _mapping(array)
    if mapping is not None and hasattr(mmap, "MADV_DONTNEED"):
        mapping.madvise(mmap.MADV_DONTNEED)


def pieces(array: AnyArray) -> Iterator[slice]:
    """Stretches of the first axis of ``BLOCK_NUMBERS`` numbers; each is released when it has been processed."""
    length = max(1, BLOCK_NUMBERS // max(1, array[:1].size))
    for first in range(0, len(array), length):
        yield slice(first, first + length)
        release(array)


def column(array: AnyArray, which: int) -> AnyArray:
    """A copy of ``array[:, which]``, for which only a piece of the array is in memory at a time."""
    return np.concatenate([array[:0, which], *(array[piece, which].copy() for piece in pieces(array))])


def _mapping(array: Any) -> mmap.mmap | None:
    while isinstance(array, np.ndarray):
        if isinstance(array, np.memmap):
            found: mmap.mmap | None = getattr(array, "_mmap", None)
            if found is not None:
                return found
        array = array.base
    return array if isinstance(array, mmap.mmap) else None
