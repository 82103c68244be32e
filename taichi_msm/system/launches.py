"""Kernels whose threads have loops, launched so that no GPU cuts a thread short; and the proof that none did.

llvmpipe ends all loops of a thread after 65,535 rounds in all and says nothing; other drivers have limits of their own.
So the loops of a thread must have a bound that does not grow with the picture or the sheet, and whoever launches a
kernel says which. An inner loop has no atomic operation: in Mesa 22.3, llvmpipe leaves such a loop after two rounds
where a group of threads is not full.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from taichi_msm.errors import DeviceError
from taichi_msm.system.runtime import our_compilation, started, ti

# Taichi starts at most this many threads on Vulkan, which share the indices of a kernel's outermost loop.
THREADS = 1 << 17

# The largest number of rounds of loops in a thread, which also bounds the time that a launch takes.
MOST_ROUNDS = 1 << 15

# Of these, so many are left to other loops than that through a list.
SPARE = 1 << 8

# The rounds of the loop that shows that a thread was not cut short.
PROOF = 2


class Launches:
    """Launches the kernels of one picture, or of one search, and makes their arrays.

    Attributes:
        bounded: whether threads are bounded and counted, as on a GPU; else every kernel is one launch.
    """

    def __init__(self, *, bounded: bool) -> None:
        self.bounded = bounded
        self._begun = 0
        # Taichi never frees an array that is dropped before the kernels that use it have ended.
        self._held: list[Any] = []
        self._ended = self.give(np.array([0, PROOF if bounded else 0], np.int32))

    def array(self, dtype: DTypeLike, length: int) -> Any:
        """Allocate an array on the device; its content is arbitrary."""
        if not self.bounded:
            return np.empty(length, dtype)
        kind = np.dtype(dtype)
        self._held.append(ti.ndarray(getattr(ti, f"{kind.kind}{8 * kind.itemsize}"), length))
        return self._held[-1]

    def give(self, values: NDArray[Any]) -> Any:
        """Put a one-dimensional array onto the device, where it stays for any number of launches."""
        if not self.bounded:
            return values
        array = self.array(values.dtype, len(values))
        array.from_numpy(values)
        return array

    def take(self, array: Any) -> NDArray[Any]:
        """Bring an array back from the device."""
        return array.to_numpy() if self.bounded else array

    def parts(self, length: int, rounds: int) -> Iterator[tuple[int, int]]:
        """Split a list that threads go through, in up to `rounds` rounds an entry, into parts for one launch each.

        Returns:
            The first entry of each part, and its length; at least one part.
        """
        most = max(1, length)
        if self.bounded:
            assert rounds <= MOST_ROUNDS - SPARE, rounds
            most = min(most, (MOST_ROUNDS - SPARE) // rounds)
        for first in range(0, max(1, length), most):
            yield first, most

    def launch(self, kernel: Callable[..., None], total: int, *arguments: Any, rounds: int) -> None:
        """Launch a kernel for the indices below `total`.

        It takes the first index, the one after the last, the array for `end_thread`, and the arguments; and at most
        `rounds` rounds of all loops together for an index.
        """
        most = total
        if self.bounded:
            rounds += PROOF + 1
            assert rounds <= MOST_ROUNDS, rounds
            most = MOST_ROUNDS // rounds * THREADS
            self._begun += total
        for first in range(0, total, most):
            with our_compilation(optimised=False):
                kernel(first, min(first + most, total), self._ended, *arguments)

    def require_ended(self) -> None:
        """Make sure that every index of every launch was worked on to its end; DeviceError: it was not."""
        if not self.bounded:
            return
        # The device counts in 32 bits.
        missing = (self._begun - int(self.take(self._ended)[0])) % (1 << 32)
        if missing:
            raise DeviceError(
                f"--arch {started().arch}: the device left out part of the work ({missing} of {self._begun} pieces), "
                "so pictures and labels would be wrong; take --arch cpu"
            )


@ti.func
def end_thread(ended: ti.template()):
    """Count an index whose work is done.

    Where a device has ended all loops of the thread, it ends this one too, and the index is not counted.
    """
    if ended[1] > 0:
        proof = 0
        for _ in range(ended[1]):
            proof += 1
        ti.atomic_add(ended[0], ti.cast(proof == ended[1], ti.i32))
