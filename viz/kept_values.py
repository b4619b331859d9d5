"""What was built for one picture and is shown in others, too."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Any, TypeVar, cast

Value = TypeVar("Value")


class KeptValues:
    """The values that were asked for last, by name; threads may share them.

    Parameters
    ----------
    most : int
        Beyond so many the one that was asked for longest ago is forgotten.
    """

    def __init__(self, most: int = 12) -> None:
        self._most = most
        self._values: OrderedDict[Hashable, Any] = OrderedDict()
        self._lock = Lock()

    def value(self, name: Hashable, build: Callable[[], Value]) -> Value:
        """Return the value of a name, built if it isn't kept; it is shared and not to be changed."""
        with self._lock:
            if name in self._values:
                self._values.move_to_end(name)
                return cast(Value, self._values[name])
        built = build()
        with self._lock:
            self._values[name] = built
            while len(self._values) > self._most:
                self._values.popitem(last=False)
        return built
