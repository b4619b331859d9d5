"""The panel of the viewer: time, what is shown, what is chosen and its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from viz.view_content import Content

NOBODY = "(none)"


@dataclass(frozen=True)
class Chosen:
    """A body, joint or marker: `number` is that of the motion's node, or of the marker."""

    content: int
    kind: Literal["body", "joint", "marker"]
    number: int


class ViewPanel:
    """Elements of the page beside the scene; the `on_` functions tie what the user does to functions."""

    def __init__(self, gui: Any, contents: Sequence[Content]) -> None:
        self.contents = contents
        self.playing = False
        first = contents[0]
        self.n_frames = max(max(1, round(c.n_frames / c.fps * first.fps)) for c in contents)
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(31, 95, 139))
        gui.main_panel.set_width(340)
        gui.add_markdown(" · ".join(f"**{_plain(c.title)}**" for c in contents))
        still = self.n_frames < 2
        with gui.add_folder("Time", visible=not still):
            self._frame = gui.add_slider("Frame", 0, max(self.n_frames - 1, 1), 1, 0, disabled=still)
            self._play = gui.add_button("Play", icon="player-play", disabled=still)
            self._speed = gui.add_dropdown("Speed", ("1", "0.5", "0.25", "0.1"))
        bodies, skin = any(c.motion for c in contents), any(c.mesh or c.surface for c in contents)
        named = bodies or any(c.markers for c in contents)
        points = any(c.points(0) is not None for c in contents)
        with gui.add_folder("Chosen", visible=named):
            self._told = gui.add_markdown("Click a body, joint or marker.")
            self._name = gui.add_text("Name", "", disabled=True)
            self._rename = gui.add_button("Rename", icon="pencil", disabled=True)
            self._status = gui.add_markdown("")
        with gui.add_folder("Show"):
            self._surface = gui.add_dropdown("Surface", ("glass", "solid", "off"), visible=skin)
            self._shows = {
                "skeleton": gui.add_checkbox("Skeleton", True, visible=bodies),
                "trails": gui.add_checkbox("Trails", True, visible=bodies),
                "names": gui.add_checkbox("Names", False, visible=named),
                "followed": gui.add_checkbox("Followed points", False, visible=any(c.followed for c in contents)),
                "ellipsoids": gui.add_checkbox("Ellipsoids", False, visible=any(c.ellipsoids for c in contents)),
                "points": gui.add_checkbox("Voxels or points", points and not skin, visible=points),
                "cameras": gui.add_checkbox("Cameras", not bodies, visible=any(c.rig for c in contents)),
            }
            self._places: dict[str, tuple[int, str]] = {}
            for k, content in enumerate(contents):
                if content.rig is not None and content.picture is not None:
                    for camera in content.rig.names:
                        self._places[camera if len(contents) == 1 else f"{content.title}: {camera}"] = (k, camera)
            options = (NOBODY, *self._places)
            self._camera = gui.add_dropdown("Picture of", options, visible=bool(self._places))
            self._picture = gui.add_image(np.full((3, 4, 3), 255, np.uint8), format="jpeg", visible=False)
        self._gui = gui
        self._play.on_click(lambda _: self._toggle())
        gui.add_command("Play or stop", hotkey="space").on_trigger(lambda _: self._toggle())

    # --- what the user does ---

    def on_look(self, act: Callable[[], object]) -> None:
        """Call a function when another frame or other things are to be shown."""
        for element in (self._frame, self._surface, self._camera, *self._shows.values()):
            # what the program sets itself comes without a client
            element.on_update(lambda event: act() if event.client is not None else None)

    def on_rename(self, act: Callable[[str], object]) -> None:
        """Call a function with the name that the user has typed."""
        self._rename.on_click(lambda _: act(str(self._name.value)))

    def on_step(self, act: Callable[[int], object]) -> None:
        """Call a function with 1 or -1 when the user goes on by a frame."""
        for words, key, by in (("Next frame", "arrowright", 1), ("Previous frame", "arrowleft", -1)):
            self._gui.add_command(words, hotkey=key).on_trigger(lambda _, by=by: act(by))

    def _toggle(self) -> None:
        self.playing = not self.playing
        self._play.label = "Stop" if self.playing else "Play"
        self._play.icon = "player-pause" if self.playing else "player-play"

    # --- what the user has set ---

    @property
    def frame(self) -> int:
        """The frame shown, at the first content's rate."""
        return min(int(self._frame.value), self.n_frames - 1)

    @frame.setter
    def frame(self, value: int) -> None:
        self._frame.value = value

    @property
    def speed(self) -> float:
        """Seconds of the recording in a second of the viewer."""
        return float(self._speed.value)

    @property
    def surface(self) -> str:
        """How the surface is drawn: solid, glass, off."""
        return str(self._surface.value)

    @property
    def camera(self) -> tuple[int, str] | None:
        """Content and camera whose picture is shown."""
        return self._places.get(str(self._camera.value))

    def shows(self, what: str) -> bool:
        """Whether a layer is shown."""
        return bool(self._shows[what].value)

    # --- what it says ---

    def say(self, words: str, wrong: bool = False) -> None:
        """Show a line below the name."""
        self._status.content = f"⚠ {_plain(words)}" if wrong else words

    def picture(self, image: np.ndarray | None) -> None:
        """Show a picture in the panel, or none."""
        if image is not None:
            self._picture.image = image
        self._picture.visible = image is not None

    def tell(self, chosen: Chosen | None) -> None:
        """Say what is known of what is chosen, in the frame shown."""
        if chosen is None:
            return
        content = self.contents[chosen.content]
        name, words = describe(content, chosen, self.frame / self.contents[0].fps)
        if self._name.disabled or (chosen, name) != getattr(self, "_last", None):
            self._name.value = name
        self._last = (chosen, name)
        free = content.results is not None and chosen.kind != "marker"
        self._name.disabled = self._rename.disabled = not free
        self._told.content = words


def describe(content: Content, chosen: Chosen, seconds: float) -> tuple[str, str]:
    """Return the name of what is chosen, and what is known of it at a time, as Markdown."""
    frame = min(round(seconds * content.fps), content.n_frames - 1)
    if chosen.kind == "marker":
        assert content.markers is not None
        name, place = content.markers.names[chosen.number], content.markers.positions[frame, chosen.number]
        where = ", ".join(f"{v:.3f}" for v in place) if np.isfinite(place).all() else "not seen"
        return name, f"**{_plain(name)}**\n\n{where} m" if np.isfinite(
            place
        ).all() else f"**{_plain(name)}**\n\n{where}"
    motion, node = content.motion, chosen.number
    assert motion is not None
    name = motion.names[node] if chosen.kind == "body" else content.joint_names[node]
    lines = [f"**{_plain(name)}**"]
    if chosen.kind == "joint":
        lines.append(f"joins {_plain(motion.names[int(motion.parents[node])])} and {_plain(motion.names[node])}")
    lines += content.told_angles(node, frame)
    lines.append(f"turned by {content.turns_deg[frame, node]:.1f}° since the first frame")
    if np.isfinite(content.confidence[node]):
        lines.append(f"confidence {content.confidence[node]:.0%}")
    return name, "\n\n".join(lines)


def _plain(text: str) -> str:
    """Return text as Markdown that shows it as it is: names come from files."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()<>#+-.!|&~$:" else " " if c in "\r\n" else c for c in text)
