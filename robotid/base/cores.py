"""The cores of the machine, and threads on them."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_order(
    work: Callable[[ItemT], ResultT],
    items: Sequence[ItemT],
    *,
    is_parallel: bool = True,
    threads: int | None = None,
) -> Iterator[ResultT]:
    """Yield the result of work for each item in order, with threads where that is faster."""
    most = (available_cores() if is_parallel else 1) if threads is None else threads
    if (workers := min(most, len(items))) <= 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(workers) as pool:
        yield from pool.map(work, items)
