"""What glibc does with memory that this process freed."""

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4  # glibc's malloc.h
_TOP_PAD = 256 * 2**20  # bytes


def keep_freed_memory() -> bool:
    """Makes glibc keep freed memory for the next update instead of giving it back to the system after every one.

    The network's intermediate results are megabytes each and are freed at every update; handing their pages back and forth
    takes a quarter of an update's time on a CPU. Without glibc nothing happens.

    Returns:
        Whether it was done.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    settings = ((_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, 2**31 - 1), (_M_TOP_PAD, _TOP_PAD))
    return all(mallopt(parameter, value) == 1 for parameter, value in settings)
