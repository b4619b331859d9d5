"""Order statistics inside kernels."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def nth_smallest(values, n):
    """Value that would be at position n of the sorted values (N,), which are put into another order.

    Hoare, Algorithm 65: Find, Communications of the ACM 4(7), 1961. NumPy's sorting takes longer to compile than most
    kernels that need one value of it.
    """
    low, high = 0, len(values) - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if n <= j:
            high = j
        elif n >= i:
            low = i
        else:
            break
    return values[n]


@njit(cache=True, nogil=True, error_model="numpy")
def median(values):
    """Median of values (N,), N ≥ 1."""
    room = values.copy()
    upper = nth_smallest(room, len(room) // 2)
    return upper if len(room) % 2 else 0.5 * (nth_smallest(room, len(room) // 2 - 1) + upper)
