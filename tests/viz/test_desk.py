"""What a review writes, and how far it is."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from geomocap.errors import RunError
from viz.desk import Desk

WHITE = np.full((8, 8, 3), 255, np.uint8)


def test_what_is_made_side_by_side_stands_in_its_order(tmp_path):
    told = []
    desk = Desk.of(tmp_path, lambda *step: told.append((threading.current_thread(), step)), 3)

    def maker(name: str, seconds: float):
        def make(own: Desk) -> str:
            time.sleep(seconds)
            own.sheet(name, WHITE, name, "")
            own.story.append((name, []))
            return name

        return make

    made = desk.side_by_side([maker("first", 0.2), maker("second", 0.1), maker("third", 0.0)])
    assert made == ["first", "second", "third"] == [path.stem for path in desk.written] == [n for n, _ in desk.story]
    assert told[-1] == (threading.current_thread(), ("review", 3, 3))
    assert {thread for thread, _ in told} == {threading.current_thread()}


def test_the_first_error_gives_up_the_rest(tmp_path):
    desk = Desk.of(tmp_path, lambda *_: None, 100)

    def endless(own: Desk) -> None:
        while True:
            own.sheet("again", WHITE, "", "")

    def broken(_: Desk) -> None:
        raise RunError("broken.npz: damaged")

    with pytest.raises(RunError, match="damaged"):
        desk.side_by_side([endless, broken])
