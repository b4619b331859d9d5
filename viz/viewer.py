"""A page in the browser that shows a run, or whatever else `viz.view_content` opens, on one time line.

Made with viser (the extra `view`). Two contents stand side by side. Bodies and joints tell their names, angles and
confidences when they are clicked, and those of runs can be renamed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from geomocap.errors import GeomocapError
from geomocap.model.palette import body_color, body_colors
from viz import shapes
from viz.scene_page import ScenePage
from viz.shown_names import rename
from viz.view_content import Content, of_run
from viz.view_panel import Chosen, ViewPanel
from viz.view_shapes import body_pieces, quaternion

_POINTS = 30_000  # that are drawn at most
_FIELD_DEG = 30.0
_JOINT = (44, 51, 61)
_MARKER = (214, 40, 90)


class Viewer(ScenePage):
    """The page and its server.

    Parameters
    ----------
    contents : sequence of Content
        One, or two to be seen side by side; time is counted in frames of the first.
    host : str
        Address to listen on.
    port : int
        The next free one is taken if it is in use.

    Raises
    ------
    MissingPackageError
        If viser isn't installed.
    GeometryError
        If there is nothing to look at.
    """

    def __init__(self, contents: Sequence[Content], host: str = "127.0.0.1", port: int = 8080) -> None:
        self.contents = list(contents)
        self._stages = [content.stage for content in self.contents]
        title = " | ".join(content.title for content in self.contents)
        super().__init__(f"geomocap: {title}", host, port, extra="view", purpose="Pages that show a run")
        self.server.scene.world_axes.visible = False
        self.server.scene.configure_fog(0.0, 1.0, enabled=False)  # large subjects stand far from the eye
        self.chosen: Chosen | None = None
        self.panel = ViewPanel(self.server.gui, self.contents)
        self._shown: list[dict[str, Any]] = []
        for k, content in enumerate(self.contents):
            self._shown.append(self._build(k, content))
        self._set_view()
        self._wire()
        self.draw()

    @property
    def n_frames(self) -> int:
        """Frames of the longest content, at the first one's rate."""
        return self.panel.n_frames

    def _pace(self) -> tuple[float, int]:
        speed = self.contents[0].fps * self.panel.speed
        rate = min(speed, 20.0)
        return rate, max(1, round(speed / rate))

    # --- what stays ---

    def _set_view(self) -> None:
        """Set floor and first view so that all is taken in."""
        stage = self._stages[0]
        wide = sum(s.diagonal for s in self._stages)
        view = stage.view(30.0, 12.0, (800, 800), _FIELD_DEG)
        R, t = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
        middle = R.T @ (np.array([0, 0, t[2]]) - t) + sum(self._offsets) / len(self._offsets)
        away = R.T @ np.array([0, 0, t[2]])
        if len(self.contents) > 1:  # both beside the panel
            away *= wide / stage.diagonal
            middle = middle + 0.2 * wide * R[0]
        self._begin_at(stage, middle, away, _FIELD_DEG)
        self._add_grid(stage, middle, 16 * max(1.0, wide / stage.diagonal))

    @property
    def _offsets(self) -> list[np.ndarray]:
        """Where each content stands: side by side along the first one's broad side."""
        if len(self.contents) == 1:
            return [np.zeros(3)]
        first, second = self._stages
        apart = 0.75 * (np.ptp(first.points @ first.broad) + np.ptp(second.points @ first.broad)) + 0.1 * first.diagonal
        to = first.centers[0] - second.centers[0] + first.broad * apart
        return [np.zeros(3), to - first.up * (to @ first.up) + first.up * (first.floor - second.floor)]

    def _build(self, k: int, content: Content) -> dict[str, Any]:
        """Draw what only moves from frame to frame: bodies, joints, names, cameras."""
        scene, stage = self.server.scene, self._stages[k]
        scene.add_frame(f"/{k}", show_axes=False, position=self._offsets[k])
        made: dict[str, Any] = {"bodies": [], "surface": [], "joints": [], "names": [], "markers": [], "cameras": {}}
        thick = 0.011 * stage.diagonal
        if content.motion is not None:
            R, p = content.posture
            for node, piece in body_pieces(content.mesh, content.motion.n_nodes) if content.mesh is not None else []:
                bones = piece.bones
                handle = scene.add_mesh_skinned(
                    f"/{k}/bodies/{node}",
                    piece.vertices,
                    piece.faces,
                    bone_wxyzs=quaternion(R[0, bones]),
                    bone_positions=p[0, bones],
                    skin_weights=piece.weights,
                    color=body_color(int(content.motion.bodies[node])),
                    side="double",
                )
                handle.on_click(lambda _, node=node: self.choose(Chosen(k, "body", node)))
                made["bodies"].append((node, bones, handle))
            for node, used, faces in content.surface.pieces() if content.surface is not None else []:
                mesh = scene.add_mesh_simple(
                    f"/{k}/surface/{node}", np.zeros((len(used), 3)), faces, side="double",
                    color=body_color(int(content.motion.bodies[node])),
                )  # fmt: skip
                mesh.on_click(lambda _, node=node: self.choose(Chosen(k, "body", node)))
                made["surface"].append((used, mesh))
            for node in range(content.motion.n_nodes):
                if content.joint_names[node]:
                    ball = scene.add_icosphere(f"/{k}/joints/{node}", 1.3 * thick, color=_JOINT)
                    ball.on_click(lambda _, node=node: self.choose(Chosen(k, "joint", node)))
                    made["joints"].append((node, ball))
                label = scene.add_label(f"/{k}/names/{node}", content.motion.names[node], anchor="center-center")
                made["names"].append((node, label))
        if content.markers is not None:
            for m, name in enumerate(content.markers.names):
                ball = scene.add_icosphere(f"/{k}/markers/{m}", 0.9 * thick, color=_MARKER)
                ball.on_click(lambda _, m=m: self.choose(Chosen(k, "marker", m)))
                label = scene.add_label(f"/{k}/marker names/{m}", name, anchor="bottom-center")
                made["markers"].append((ball, label))
        if content.rig is not None:
            rig, away = content.rig, np.linalg.norm(content.rig.centers - stage.centers[0], axis=1)
            for c, name in enumerate(rig.names):
                scale = 0.14 * float(np.median(away))
                made["cameras"][name] = self._add_camera(f"/{k}/cameras/{c}", rig, c, scale)
        return made

    def _wire(self) -> None:
        """Tie the panel's elements to what they do."""
        self.panel.on_look(self.draw)
        self.panel.on_rename(self.rename)
        self.panel.on_step(self._step)

    def _step(self, by: int) -> None:
        self.panel.frame = (self.panel.frame + by) % self.n_frames
        self.draw()

    # --- what the user does ---

    def choose(self, chosen: Chosen | None) -> None:
        """Show what is known of a body, joint or marker."""
        with self._lock:
            self.chosen = chosen
            self.panel.tell(chosen)

    def rename(self, name: str) -> None:
        """Give the chosen body or joint of a run another name, and write it down."""
        with self._lock:
            chosen = self.chosen
            content = None if chosen is None else self.contents[chosen.content]
            if chosen is None or content is None or content.results is None or content.motion is None:
                self.panel.say("Choose a body or joint of a run first.", wrong=True)
                return
            motion = content.motion
            number = int((motion.bodies if chosen.kind == "body" else motion.joints)[chosen.number])
            try:
                file = rename(content.results, chosen.kind, number, name.strip())
                self.contents[chosen.content] = of_run(content.results)
            except GeomocapError as error:
                self.panel.say(str(error), wrong=True)
                return
            self.panel.contents = self.contents
            renamed = self.contents[chosen.content].motion
            for node, label in self._shown[chosen.content]["names"]:
                label.text = renamed.names[node] if renamed is not None else ""
            self.panel.tell(chosen)
            self.panel.say(f"Written to {file.name}. `geomocap export` gives the motion files these names.")

    # --- what a frame shows ---

    def place(self, content: Content) -> int:
        """Return the frame of a content at the time of the frame that the slider shows."""
        seconds = self.panel.frame / self.contents[0].fps
        return min(round(seconds * content.fps), content.n_frames - 1)

    def draw(self) -> None:
        """Draw the frame."""
        with self._lock, self.server.atomic():
            for k, content in enumerate(self.contents):
                self._draw(k, content, self.place(content))
            self.panel.tell(self.chosen)
        self._draw_picture()

    def _draw(self, k: int, content: Content, frame: int) -> None:
        made, shows = self._shown[k], self.panel.shows
        if content.motion is not None:
            R, p = (values[frame] for values in content.posture)
            turned = quaternion(R)
            for _, bones, handle in made["bodies"]:
                handle.visible = self.panel.surface != "off"
                handle.opacity = 0.4 if self.panel.surface == "glass" else None
                for own, bone in zip(bones, handle.bones, strict=True):
                    bone.wxyz, bone.position = turned[own], p[own]
            self._surface(content, frame, made["surface"])
            for node, ball in made["joints"]:
                ball.position, ball.visible = p[node], shows("skeleton")
            ends = content.bone_ends(frame)
            colors = [body_color(int(content.motion.bodies[n])) for n, _ in content.bones]
            self._lines(f"/{k}/bones", ends if shows("skeleton") else ends[:0], colors, 5.0)
            middles = {node: end.mean(axis=0) for (node, _), end in zip(content.bones, ends, strict=True)}
            for node, label in made["names"]:
                label.position, label.visible = middles.get(node, p[node]), shows("names")
            self._trails(k, content, frame)
        if content.markers is not None:
            for (ball, label), place in zip(made["markers"], content.markers.positions[frame], strict=True):
                known = bool(np.isfinite(place).all())
                ball.visible, label.visible = known, known and shows("names")
                if known:
                    ball.position, label.position = place, place + self._stages[k].up * 0.02 * self._stages[k].diagonal
        self._draw_points(f"/{k}/points", content.points(frame) if shows("points") else None, _POINTS, 1.1)
        self._followed(k, content, frame)
        self._ellipsoids(k, content, frame)
        for name, frustum in made["cameras"].items():
            frustum.visible = shows("cameras")
            if shows("cameras") and content.picture is not None:
                frustum.image = content.picture(name, frame, 240)

    def _surface(self, content: Content, frame: int, pieces: list[tuple[np.ndarray, Any]]) -> None:
        """Put the pieces of a surface that moves by rules of its own where they are in this frame."""
        shown = content.surface is not None and self.panel.surface != "off"
        vertices = content.surface.at(frame).astype(np.float32) if content.surface is not None and shown else None
        for used, mesh in pieces:
            mesh.visible, mesh.opacity = shown, 0.4 if self.panel.surface == "glass" else None
            if vertices is not None:
                mesh.vertices = vertices[used]

    def _followed(self, k: int, content: Content, frame: int) -> None:
        """Draw the points that the bodies were found from, where they are in this frame."""
        name, followed = f"/{k}/followed", content.followed
        places = np.zeros((0, 3)) if followed is None else followed.places[:, frame]
        seen = np.isfinite(places).all(axis=1)
        if followed is None or not self.panel.shows("followed") or not seen.any():
            self._remove(name)
            return
        middle = places[seen].mean(axis=0)
        self.server.scene.add_point_cloud(
            name, places[seen] - middle, body_colors(followed.bodies[seen]), point_shape="circle", position=middle,
            point_size=0.004 * self._stages[k].diagonal,
        )  # fmt: skip

    def _ellipsoids(self, k: int, content: Content, frame: int) -> None:
        name, shells = f"/{k}/ellipsoids", content.ellipsoids
        centers = np.zeros((0, 3)) if shells is None else shells.centers[frame]
        seen = np.isfinite(centers).all(axis=1)
        if shells is None or not self.panel.shows("ellipsoids") or not seen.any():
            self._remove(name)
            return
        sphere = shapes.ball(np.zeros(3), 1.0, (0, 0, 0), level=3)
        self.server.scene.add_batched_meshes_simple(
            name, sphere.vertices, sphere.faces, quaternion(shells.rotations[frame, seen]), centers[seen],
            batched_scales=shells.radii[frame, seen], batched_colors=body_colors(shells.bodies[seen]), opacity=0.5,
            lod="off",
        )  # fmt: skip

    def _trails(self, k: int, content: Content, frame: int, length: int = 24) -> None:
        """Draw the ways of the joints over the last frames."""
        assert content.motion is not None
        first = max(0, frame - length)
        way = content.posture[1][first : frame + 1, 1:] if self.panel.shows("trails") else np.zeros((0, 0, 3))
        ends = np.stack([way[:-1], way[1:]], axis=2).reshape(-1, 2, 3)
        colors = [body_color(int(b)) for b in content.motion.bodies[1:]] * max(0, len(way) - 1)
        self._lines(f"/{k}/trails", ends, colors, 2.0)

    def _lines(self, name: str, ends: np.ndarray, colors: Sequence[Sequence[int]], width: float) -> None:
        """Draw lines, each in its colour."""
        self._draw_lines(name, ends, np.repeat(np.array(colors, np.uint8)[:, None], 2, axis=1), width)

    def _draw_picture(self) -> None:
        """Show the picture of the camera that is chosen in the panel."""
        where = self.panel.camera
        if where is None:
            self.panel.picture(None)
            return
        content = self.contents[where[0]]
        picture = None if content.picture is None else content.picture(where[1], self.place(content), 560)
        self.panel.picture(picture)
