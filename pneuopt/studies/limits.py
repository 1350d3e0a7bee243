"""A limit of memory for a process of a study, so that a case that fills it costs no other."""

import math
import sys

_MEGABYTE = 2**20


def limit_memory(megabytes: float) -> None:
    """Let this process have so much more memory than it has now; beyond it an allocation fails.

    Data alone are limited, not the address space, of which threads reserve gigabytes that they never touch.
    """
    if sys.platform != "linux" or megabytes == math.inf:
        return
    import resource

    with open("/proc/self/statm", encoding="ascii") as file:  # noqa: PTH123 - no file of ours
        pages = int(file.read().split()[5])  # data and stack
    most = pages * resource.getpagesize() + int(megabytes * _MEGABYTE)
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    resource.setrlimit(resource.RLIMIT_DATA, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
