"""How a process on the CPU keeps the memory that its updates work in."""

import ctypes
import os

# From malloc.h and mman.h of Linux.
_M_TRIM_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -4, -8
_MADV_HUGEPAGE = 14
_HUGE_PAGE = 2 << 20


def keep_freed_memory(reserve: int | None = None) -> bool:
    """Makes this process keep the memory it frees, in huge pages, for its next allocations.

    A jitted update allocates hundreds of megabytes and frees them at its end. By default glibc
    returns blocks of that size to the system, so every update pays for a hundred thousand page
    faults: a quarter of its time at small sizes. A program calls this once, as it starts; it
    is a setting of the whole process, so no library function does. What it costs: memory that was
    used once is not returned before the process ends.

    Args:
      reserve: bytes of address space for huge pages; half of the machine's memory by default. None
        of it is used before it is allocated.

    Returns:
      Whether it could be done: not where the C library is another than glibc.
    """
    library = ctypes.CDLL(None)
    if not all(hasattr(library, name) for name in ("mallopt", "gnu_get_libc_version", "madvise")):
        return False
    library.malloc.restype = ctypes.c_void_p
    library.malloc.argtypes = [ctypes.c_size_t]
    library.free.argtypes = [ctypes.c_void_p]
    library.madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    # All threads allocate from one heap, which holds blocks of any size and never shrinks.
    settings = ((_M_ARENA_MAX, 1), (_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, -1))
    done = all([library.mallopt(name, value) for name, value in settings])
    if reserve is None:
        reserve = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    # The heap grows by this block and keeps it once it is freed, with the advice given for it.
    block = library.malloc(reserve)
    if block:
        start = -(-block // _HUGE_PAGE) * _HUGE_PAGE
        end = (block + reserve) // _HUGE_PAGE * _HUGE_PAGE
        if end > start:
            library.madvise(start, end - start, _MADV_HUGEPAGE)
        library.free(block)
    return done
