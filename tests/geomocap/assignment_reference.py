"""The heaviest choices searched with whole numbers as sets: slow and obvious, what the kernel must agree with."""

from __future__ import annotations

import numpy as np

from geomocap.naming.best_assignment import MOST_NODES


def heaviest_choices_python(
    weights: np.ndarray, groups: np.ndarray, kinds: np.ndarray, excluded: np.ndarray, above: float = -np.inf
) -> list[int] | None:
    """Choose as `heaviest_choices`."""
    order = np.argsort(-weights, kind="stable")[::-1]
    value = weights[order].tolist()
    apart = excluded | (groups[:, None] == groups) | (kinds[:, None] == kinds)
    allowed = [_bits(row) for row in ~apart[np.ix_(order, order)]]
    other_groups = [_bits(row) for row in groups[order, None] != groups[order]]
    other_kinds = [_bits(row) for row in kinds[order, None] != kinds[order]]
    best: tuple[float, list[int] | None] = (above, None)
    stack: list[tuple[int, float, list[int]]] = [((1 << len(value)) - 1, 0.0, [])]
    nodes = 0
    while stack and nodes < MOST_NODES:
        nodes += 1
        left, total, taken = stack.pop()
        if total > best[0] + 1e-12:
            best = total, taken
        least = best[0] + 1e-12
        if not (_exceeds(least, total, left, other_groups, value) and _exceeds(least, total, left, other_kinds, value)):
            continue
        first = left.bit_length() - 1
        stack.append((left & ~(1 << first), total, taken))
        stack.append((left & allowed[first], total + value[first], [*taken, first]))
    return None if best[1] is None else [int(order[i]) for i in best[1]]


def _exceeds(least: float, total: float, left: int, others: list[int], value: list[float]) -> bool:
    while left:
        first = left.bit_length() - 1
        total += value[first]
        if total > least:
            return True
        left &= others[first]
    return False


def _bits(mask: np.ndarray) -> int:
    return int.from_bytes(np.packbits(mask, bitorder="little").tobytes(), "little")
