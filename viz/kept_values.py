"""What was built for one picture and is shown in others, too."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, TypeVar, cast

Value = TypeVar("Value")


class KeptValues:
    """The values that were asked for last, by name; threads may share them, and each value is built by one of them.

    Parameters
    ----------
    most : int
        Beyond so many the one that was asked for longest ago is forgotten.
    """

    def __init__(self, most: int = 12) -> None:
        self._most = most
        self._values: OrderedDict[Hashable, _Kept] = OrderedDict()
        self._lock = Lock()

    def value(self, name: Hashable, build: Callable[[], Value]) -> Value:
        """Return the value of a name, built if it isn't kept; it is shared and not to be changed.

        Another thread that asks for it meanwhile waits.
        """
        with self._lock:
            kept = self._values.setdefault(name, _Kept())
            self._values.move_to_end(name)
            while len(self._values) > self._most:
                self._values.popitem(last=False)
        with kept.lock:
            if not kept.built:
                kept.value, kept.built = build(), True
        return cast(Value, kept.value)


@dataclass
class _Kept:
    """A value, once it is built."""

    lock: Lock = field(default_factory=Lock)
    built: bool = False
    value: Any = None
