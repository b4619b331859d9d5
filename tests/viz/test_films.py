"""The film of a review, made beside its other parts."""

from __future__ import annotations

from pathlib import Path
from threading import Event, Timer, get_ident

import pytest

from geomocap.progress import Progress
from tests.viz.conftest import Made
from viz import films
from viz.run_contents import Results
from viz.scene import stage


def test_a_film_is_given_up_with_the_review_that_it_is_made_beside(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = Results(made.run, made.capture)
    place = stage(results)
    drawn = []

    def draw(*_: object, progress: Progress, **__: object) -> None:
        for k in range(100):
            progress("video", k, 100)
            drawn.append(k)
            started.set()
            gone.wait(60)

    started, gone = Event(), Event()
    monkeypatch.setattr(films, "motion_video", draw)
    with pytest.raises(ValueError), films.filmed_beside(results, place, tmp_path / "motion.mp4"):
        assert started.wait(60)
        Timer(0.2, gone.set).start()
        raise ValueError
    assert drawn == [0]


def test_who_began_a_film_is_told_how_far_it_is(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = Results(made.run, made.capture)

    def draw(*_: object, progress: Progress, **__: object) -> None:
        assert get_ident() != here
        for k in range(4):
            progress("video", k, 3)

    here, told = get_ident(), []
    monkeypatch.setattr(films, "motion_video", draw)
    path = tmp_path / "motion.mp4"
    with films.filmed_beside(results, stage(results), path, lambda *call: told.append((get_ident(), call))) as film:
        assert film() == path
    assert told[-1] == (here, ("video", 3, 3))
    assert {thread for thread, _ in told} == {here}


@pytest.mark.parametrize(
    ("frames", "fps", "step"),
    [(60, 30.0, 1), (60, 29.97, 1), (60, 59.94, 2), (60, 50.0, 2), (60, 120.0, 4), (60, 5.0, 1), (101, 30.0, 2)],
)
def test_films_are_smooth_and_short(frames: int, fps: float, step: int) -> None:
    assert films.thinning(frames, fps, at_most=100) == step
