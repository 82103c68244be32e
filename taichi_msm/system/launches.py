"""Kernel launches with bounded loops, because GPUs end long threads early, and a check for completion.

llvmpipe ends all loops of a thread after 65,535 iterations in total, without an error; other drivers have other limits.
So every launch states a bound of the iterations per thread, which must not grow with the picture or the sheet. An inner
loop must not contain an atomic operation: in Mesa 22.3, llvmpipe leaves such a loop after two iterations if a group of
threads is not full.
"""

# No `from __future__ import annotations`: Taichi evaluates the annotations of kernels.

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from taichi_msm.errors import DeviceError
from taichi_msm.system.runtime import compilation_options, current_device, ti

# Largest number of threads that Taichi starts on Vulkan; they share the indices of a kernel's outermost loop.
VULKAN_THREADS = 1 << 17

# Largest number of loop iterations in a thread, which also bounds the duration of a launch.
MAX_ROUNDS = 1 << 15

# Part of MAX_ROUNDS for the other loops of a kernel that iterates over a chunk of a list.
RESERVED_ROUNDS = 1 << 8

# Iterations of the loop in `end_thread`; a thread that was ended early does not complete them.
PROOF_ROUNDS = 2


class Launches:
    """Launches of the kernels of one picture or of one tracking query, with their device arrays.

    With `bounded`, as on a GPU, loops are bounded and finished indices are counted. Otherwise every kernel is one
    launch, and arrays are NumPy arrays.
    """

    def __init__(self, *, bounded: bool) -> None:
        self.bounded = bounded
        self._launched = 0
        # Taichi leaks an array that is dropped before the kernels that use it have ended.
        self._arrays: list[Any] = []
        self._ended = self.upload(np.array([0, PROOF_ROUNDS if bounded else 0], np.int32))

    def array(self, dtype: DTypeLike, length: int) -> Any:
        """Allocate an uninitialised array of integers or real numbers, shape (length,), on the device."""
        if not self.bounded:
            return np.empty(length, dtype)
        kind = np.dtype(dtype)
        self._arrays.append(ti.ndarray(getattr(ti, f"{kind.kind}{8 * kind.itemsize}"), length))
        return self._arrays[-1]

    def upload(self, values: NDArray[Any]) -> Any:
        """Copy an array, shape (length,), to the device."""
        if not self.bounded:
            return values
        array = self.array(values.dtype, len(values))
        array.from_numpy(values)
        return array

    def download(self, array: Any) -> NDArray[Any]:
        """Copy an array, shape (length,), from the device."""
        return array.to_numpy() if self.bounded else array

    def chunks(self, length: int, rounds: int) -> Iterator[tuple[int, int]]:
        """Split a list, over which every thread iterates, into chunks; yield the first entry and the length of each.

        There is at least one chunk. `rounds` is the largest number of loop iterations for an entry.
        """
        chunk = max(1, length)
        if self.bounded:
            assert rounds <= MAX_ROUNDS - RESERVED_ROUNDS, rounds
            chunk = min(chunk, (MAX_ROUNDS - RESERVED_ROUNDS) // rounds)
        for first in range(0, max(1, length), chunk):
            yield first, chunk

    def launch(self, kernel: Callable[..., None], total: int, *arguments: Any, rounds: int) -> None:
        """Launch kernel(first, end, ended, *arguments) for all indices below `total`, in several launches if necessary.

        `ended` is for `end_thread`, and `rounds` is the largest number of loop iterations per index, over all loops.
        """
        batch = total
        if self.bounded:
            rounds += PROOF_ROUNDS + 1
            assert rounds <= MAX_ROUNDS, rounds
            batch = MAX_ROUNDS // rounds * VULKAN_THREADS
            self._launched += total
        for first in range(0, total, batch):
            with compilation_options(optimised=False):
                kernel(first, min(first + batch, total), self._ended, *arguments)

    def require_completion(self) -> None:
        """Raise a DeviceError if the device ended a thread before its last index."""
        if not self.bounded:
            return
        # The device counts in 32 bits.
        missing = (self._launched - int(self.download(self._ended)[0])) % (1 << 32)
        if missing:
            raise DeviceError(
                f"--arch {current_device().arch}: the device left out part of the work ({missing} of {self._launched} "
                "pieces), so pictures and labels would be wrong; take --arch cpu"
            )


@ti.func
def end_thread(ended: ti.template()):
    """Count a finished index; a kernel calls this at the end of every index.

    If the device has ended the loops of the thread, it also ends the loop here, and the index is not counted.
    """
    if ended[1] > 0:
        proof = 0
        for _ in range(ended[1]):
            proof += 1
        ti.atomic_add(ended[0], ti.cast(proof == ended[1], ti.i32))
