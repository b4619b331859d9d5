"""Windows of a long recording: what is tracked and fitted at a time, so that memory hardly grows with the length."""

from __future__ import annotations

from pydantic import Field, model_validator

from geomocap.settings import Settings


class WindowSettings(Settings):
    """How a long recording is divided.

    Two windows of up to 150 frames at once take about 2 GB (eight cameras, 320×240); of a man walking about, the core
    index of the bodies is .98 then, of 60 frames .94. Velocities look at three frames on each side: the pose that is
    handed over in the middle of twelve shared frames has as many in both windows. Other lengths weren't measured.
    """

    frames: int = Field(150, ge=12, le=1_000_000, description="longest recording, or window of one, done in one piece")
    overlap: int = Field(12, ge=2, le=1000, description="frames that neighbouring windows share")

    @model_validator(mode="after")
    def _overlap_within(self) -> WindowSettings:
        if 2 * self.overlap >= self.frames:
            raise ValueError(f"overlap: {self.overlap} is half of {self.frames} frames or more; take less")
        return self


def windows_of(frames: int, settings: WindowSettings) -> list[range]:
    """Divide frames into windows of nearly equal length, each of which shares frames with the next.

    Parameters
    ----------
    frames : int
    settings : WindowSettings

    Returns
    -------
    list of range
        A single one if all the frames fit into it.
    """
    if frames <= settings.frames:
        return [range(frames)]
    shared = settings.overlap
    count = -(-(frames - shared) // (settings.frames - shared))
    edges = [round(k * (frames - shared) / count) for k in range(count + 1)]
    return [range(edges[k], edges[k + 1] + shared) for k in range(count)]
