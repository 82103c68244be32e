"""Results of slow functions, kept in memory by a digest of their input."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Limits of all arrays: their size [bytes], of which a picture of 1024 x 1024 pixels needs 9 MiB with its mipmap levels,
# and their number.
MAX_BYTES, MAX_KEYS = 2**28, 256

_arrays: OrderedDict[Hashable, tuple[NDArray[Any], ...]] = OrderedDict()
_lock = Lock()


def cached_arrays(key: Hashable, compute: Callable[[], tuple[NDArray[Any], ...]]) -> tuple[NDArray[Any], ...]:
    """Return the arrays of a key, read-only; beyond the limits, the least recently used ones are dropped.

    The key contains the name of the function, and digests and values on which its result depends.
    """
    arrays = _arrays.get(key) or compute()
    for array in arrays:
        array.flags.writeable = False
    with _lock:
        _arrays[key] = arrays
        _arrays.move_to_end(key)
        while (
            len(_arrays) > MAX_KEYS or sum(array.nbytes for arrays in _arrays.values() for array in arrays) > MAX_BYTES
        ):
            _arrays.popitem(last=False)
    return arrays
