"""What was built for one picture is shown in others, too."""

from __future__ import annotations

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
