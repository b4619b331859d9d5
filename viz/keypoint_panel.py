"""The panel of the key-point editor: time, the chosen key-point, edits, what is shown."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np

from geomocap.keypoints.keypoint_following import REACH, KeyPointPaths
from geomocap.trajectories.smoothing import smooth_motion
from viz.keypoint_marks import Marks
from viz.keypoint_scene import Subject, timeline
from viz.keypoint_session import Session

NOBODY = "(none)"
HELP = (
    "**Click the surface** to place a key-point, click a key-point to choose it. Drag its **arrows** to move it; it is "
    "then followed from the frame shown. Drag beside it to turn the view, scroll to zoom, right-drag to shift. "
    "Keys: **← →** frame, **space** play, **Ctrl+Z** and **Ctrl+Y** undo and redo, **Ctrl+S** save."
)
_OBJECTS = {"delete": " key-point", "undo": "", "redo": "", "save": "", "next": " frame", "previous": " frame"}


class Panel:
    """Elements of the page beside the scene; `on` ties what the user does to functions."""

    def __init__(self, gui: Any, subject: Subject) -> None:
        self._gui, self._subject = gui, subject
        self.playing = False
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(20, 110, 230))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(380)
        gui.add_markdown(HELP)
        with gui.add_folder("Time"):
            last = max(subject.n_frames - 1, 1)
            self._frame = gui.add_slider("Frame", 0, last, 1, 0, disabled=subject.n_frames < 2)
            self._play = gui.add_button("Play", icon="player-play", disabled=subject.n_frames < 2)
        with gui.add_folder("Key-point"):
            self._chosen = gui.add_dropdown("Chosen", (NOBODY,))
            self._name = gui.add_text("Name", "")
            self._radius = gui.add_slider("Radius (mm)", 5, 150, 1, 30)
            self._link = gui.add_dropdown(
                "Link with", (NOBODY,), hint="Joins two key-points by a line in plots; once more takes it away"
            )
            self._told = gui.add_markdown("")
        self._timeline = gui.add_html("")
        with gui.add_folder("Edit"):
            self._edits = gui.add_button_group("", ("Undo", "Redo", "Delete"))
            self._save = gui.add_button("Save", icon="device-floppy", color="green")
            self._status = gui.add_markdown("")
        with gui.add_folder("Show"):
            self._shown = {"surface": gui.add_checkbox("Surface", True)}
            self._trails = gui.add_dropdown("Trajectories", ("by speed", "by direction", "none"))
            self._camera = gui.add_dropdown("Picture of", (*subject.cameras, NOBODY), visible=bool(subject.cameras))
            self._picture = gui.add_image(np.full((3, 4, 3), 255, np.uint8), format="jpeg", visible=False)
            self._through = gui.add_button("Look through this camera", icon="camera", visible=bool(subject.cameras))
            self._shown["cameras"] = gui.add_checkbox("Cameras", False, visible=bool(subject.cameras))
        self._elements = {
            "frame": [self._frame],
            "look": [*self._shown.values(), self._trails, self._camera],
            "chosen": [self._chosen],
            "name": [self._name],
            "radius": [self._radius],
            "link": [self._link],
        }
        self._keys: dict[str, tuple[str, str | None]] = {
            "delete": ("delete", None),
            "undo": ("Z", "cmd/ctrl"),
            "redo": ("Y", "cmd/ctrl"),
            "save": ("S", "cmd/ctrl"),
            "next": ("arrowright", None),
            "previous": ("arrowleft", None),
        }
        self._play.on_click(lambda _: self._toggle())
        gui.add_command("Play or stop", hotkey="space").on_trigger(lambda _: self._toggle())

    def on(self, what: str, act: Callable[[], object]) -> None:
        """Call a function when the user changes an element or presses a button, with the mouse or a key."""
        for element in self._elements.get(what, []):
            # what the program sets itself comes without a client
            element.on_update(lambda event: act() if event.client is not None else None)
        if what.title() in self._edits.options:
            self._edits.on_click(lambda event: act() if event.target.value == what.title() else None)
        if what == "save":
            self._save.on_click(lambda _: act())
        if what in self._keys:
            key, modifier = self._keys[what]
            command = self._gui.add_command(f"{what.capitalize()}{_OBJECTS[what]}", hotkey=key, modifier=modifier)
            command.on_trigger(lambda _: act())

    def on_client(self, what: str, act: Callable[[Any], object]) -> None:
        """Call a function with the client whose user pressed a button."""
        {"through": self._through}[what].on_click(lambda event: act(event.client))

    def _toggle(self) -> None:
        self.playing = not self.playing
        self._play.label = "Stop" if self.playing else "Play"
        self._play.icon = "player-pause" if self.playing else "player-play"

    # --- what the user has set ---

    @property
    def frame(self) -> int:
        """The frame shown."""
        return min(int(self._frame.value), self._subject.n_frames - 1)

    @frame.setter
    def frame(self, value: int) -> None:
        self._frame.value = value

    @property
    def chosen(self) -> str | None:
        """Name in the list of key-points."""
        return None if self._chosen.value == NOBODY else str(self._chosen.value)

    @property
    def name(self) -> str:
        """Text in the name field."""
        return str(self._name.value)

    @property
    def radius(self) -> float:
        """Radius, metres."""
        return float(self._radius.value) / 1000

    @property
    def link(self) -> str:
        """Key-point to link with."""
        return str(self._link.value)

    @property
    def trails(self) -> str:
        """What colours trajectories: speed, direction, none."""
        return str(self._trails.value).removeprefix("by ")

    @property
    def camera(self) -> str:
        """Camera whose picture is shown."""
        return str(self._camera.value)

    def shows(self, what: str) -> bool:
        """Whether a part of the scene is shown."""
        return bool(self._shown[what].value)

    # --- what it shows ---

    def say(self, words: str, wrong: bool = False) -> None:
        """Show a line below the buttons."""
        said = escape(words)
        self._status.content = f"⚠ {said}" if wrong else said

    def picture(self, image: np.ndarray | None) -> None:
        """Show a picture in the panel, or none."""
        if image is not None:
            self._picture.image = image
        self._picture.visible = image is not None

    def fill(self, session: Session, paths: KeyPointPaths, marks: Marks, typing: bool = False) -> None:
        """Show what the session holds."""
        names, point = session.file.names, session.point
        self._chosen.options = (NOBODY, *names)
        self._chosen.value = session.chosen or NOBODY
        linked = {n for link in session.file.links if session.chosen in link for n in link}
        self._link.options = (NOBODY, *(n for n in names if n != session.chosen))
        self._link.value = NOBODY
        if not typing:
            self._name.value = session.chosen or ""
        for element in (self._name, self._radius):
            element.disabled = point is None
        self._link.disabled = point is None or len(names) < 2
        if point is not None:
            self._radius.value = round(np.clip(1000 * point.radius, 5, 150))
            self._told.content = self._words(session, paths, linked)
        else:
            self._told.content = "Click the surface to place one." if not names else "None is chosen."
        self._save.disabled = not session.is_changed
        self._timeline.content = timeline(marks, self.frame)

    def _words(self, session: Session, paths: KeyPointPaths, linked: set[str]) -> str:
        """Say how well the chosen key-point is followed."""
        point = session.point
        assert point is not None
        k, t = session.file.names.index(point.name), self.frame
        present = np.isfinite(paths.positions[:, k, 0])
        if paths.n_tracks[point.frame, k] == 0:
            reach = 1000 * REACH * point.radius
            return f"⚠ **No trajectory within {reach:.0f} mm**: move or enlarge it, or place it in another frame."
        bridged = int((paths.bridged[:, k] & present).sum())
        words = f"Placed in frame {point.frame}; followed in **{present.sum()} of {len(present)}** frames"
        words += f", {bridged} of them bridged. " if bridged else ". "
        if not present[t]:
            words += "**Lost in this frame.**"
        elif t == point.frame:
            words += f"Here it has {paths.n_tracks[t, k]} trajectories {'around' if paths.bridged[t, k] else 'inside'}."
        else:
            motion = smooth_motion(paths.positions[None, :, k], self._subject.fps)
            speed = float(np.linalg.norm(motion.velocities[0, t]))
            how = "bridged by" if paths.bridged[t, k] else "moved by"
            words += f"Here {how} {paths.n_tracks[t, k]} trajectories, ± {1000 * paths.std[t, k]:.1f} mm"
            words += f", {speed:.2f} m/s." if np.isfinite(speed) else "."
        others = ", ".join(sorted(linked - {point.name}))
        return words + (f" Linked with {escape(others)}." if others else "")
