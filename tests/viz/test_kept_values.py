"""What was built for one picture is shown in others, too."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

from viz.kept_values import KeptValues


def test_values_are_built_once_and_those_asked_for_longest_ago_forgotten():
    built = []
    kept = KeptValues(most=2)

    def value(name):
        return kept.value(name, lambda: built.append(name) or f"value of {name}")

    assert [value(n) for n in "aab"] == ["value of a", "value of a", "value of b"]
    assert built == ["a", "b"]
    value("a")
    value("c")  # b goes
    value("a")
    assert built == ["a", "b", "c"]
    value("b")
    assert built == ["a", "b", "c", "b"]


def test_threads_that_ask_together_get_one_value():
    built = []
    kept = KeptValues()

    def build():
        time.sleep(0.05)
        built.append(1)
        return object()

    with ThreadPoolExecutor(4) as executor:
        values = list(executor.map(lambda _: kept.value("mesh", build), range(4)))
    assert len(built) == 1
    assert len({id(value) for value in values}) == 1
