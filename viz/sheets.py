"""Contact sheets of a run: frames beside each other, views or cameras below each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from geomocap.scheduling import map_items, threads
from viz import body_colors as palette
from viz import scene
from viz.drawing import DENSITY, faded, fit, outlined, resize, sheet, write_on
from viz.floor import floor
from viz.rendering import Look, Model, render
from viz.run_contents import Results
from viz.shapes import Mesh, frustum
from viz.viewpoints import PinholeView, ViewStage, camera_view, shown_size, window_around

VIEWS = {"three-quarter": (35.0, 15.0), "broad side": (0.0, 5.0), "narrow side": (90.0, 5.0), "top": (0.0, 80.0)}
"""Free views: azimuth and elevation, degrees. Broad and narrow refer to the subject, whatever it is."""

FINE = Look(samples=1, reach=5.0 * DENSITY)
"""How sheets are drawn: so many pixels need no more rays."""

Builder = Callable[[Results, int], list[Mesh]]


def chosen_frames(frames: Sequence[int], count: int) -> list[int]:
    """Return at most `count` of the frames, evenly spread, the first one included."""
    if len(frames) <= count:
        return list(frames)
    return [frames[round(p)] for p in np.linspace(0, len(frames) - 1, count)]


def tile_size(
    stage: ViewStage, azimuth_deg: float, elevation_deg: float, area: float = 85_000 * DENSITY**2
) -> tuple[int, int]:
    """Return the width and height of a picture that suits what a view sees, about `area` pixels large."""
    view = stage.view(azimuth_deg, elevation_deg, (1000, 1000))
    pixels, _ = view.project(stage.points + stage.centers[0])
    width, height = np.maximum(np.ptp(pixels, axis=0), 1)
    aspect = float(np.clip(width / height, 0.48, 2.0))
    return 2 * round((area * aspect) ** 0.5 / 2), 2 * round((area / aspect) ** 0.5 / 2)


def picture(
    results: Results, stage: ViewStage, model: Model, view: PinholeView, frame: int, look: Look = FINE
) -> np.ndarray:
    """Return a free view of a model on the floor, (H, W, 4) uint8: RGB and opacity."""
    place = results.place(frame)
    moved = stage.at(view, place)
    center = stage.centers[min(place, len(stage.centers) - 1)]
    return model.render(moved, look, stage.up).above(floor(stage, moved, model.meshes, center)).clear()


def volume_meshes(results: Results, frame: int) -> list[Mesh]:
    """Return the volume or the cloud in its colours."""
    return [scene.volume(results, frame)]


def ellipsoid_meshes(results: Results, frame: int) -> list[Mesh]:
    """Return the ellipsoids in the colours of their bodies."""
    return [scene.ellipsoids(results, frame)]


def body_meshes(results: Results, frame: int) -> list[Mesh]:
    """Return the bodies, each in its colour."""
    return [scene.bodies(results, frame)]


def skeleton_meshes(results: Results, frame: int) -> list[Mesh]:
    """Return the skeleton inside the translucent volume."""
    skin = scene.body_skin(results, frame)
    size = float(np.linalg.norm(np.ptp(skin.vertices, axis=0))) if len(skin.vertices) else 1.0
    return [scene.glass(skin), *scene.skeleton(results, frame, size)]


def path_meshes(results: Results, frame: int) -> list[Mesh]:
    """Return the paths of all frames with the volume of one frame as glass."""
    skin = scene.body_skin(results, frame)
    size = float(np.linalg.norm(np.ptp(skin.vertices, axis=0))) if len(skin.vertices) else 1.0
    return [skin.recolored(scene.GLASS).translucent(0.08, 0.35), scene.paths(results, size)]


def geometry_views(
    results: Results, stage: ViewStage, frames: Sequence[int], build: Builder, views: Sequence[str] = tuple(VIEWS)
) -> list[list[np.ndarray]]:
    """Return pictures of one kind of geometry: for each free view those of all frames."""
    seen_from = [stage.view(*VIEWS[v], tile_size(stage, *VIEWS[v])) for v in views]

    def column(frame: int) -> list[np.ndarray]:
        model = Model(build(results, frame))
        return [picture(results, stage, model, view, frame) for view in seen_from]

    with threads() as executor:
        columns = list(map_items(column, list(frames), executor))
    return [list(row) for row in zip(*columns, strict=True)]


def frames_sheet(rows: Sequence[tuple[str, list[np.ndarray]]], frames: Sequence[int]) -> np.ndarray:
    """Return a sheet with named rows of pictures, frames as columns."""
    return sheet([pictures for _, pictures in rows], [name for name, _ in rows], [f"frame {f}" for f in frames])


def still(results: Results, stage: ViewStage, frame: int, size: tuple[int, int] = (1440, 900)) -> np.ndarray:
    """Return one picture of the skeleton inside the translucent volume, where nothing can be turned."""
    azimuth, elevation = VIEWS["three-quarter"]
    model = Model(skeleton_meshes(results, frame))
    return picture(results, stage, model, stage.view(azimuth, elevation, size), frame)


def path_sheet(results: Results, stage: ViewStage, frame: int) -> np.ndarray:
    """Return the paths of the whole sequence, views beside each other, with the volume of one frame as glass."""
    model = Model(path_meshes(results, frame))
    seen_from = [stage.view(*angles, tile_size(stage, *angles, 130_000 * DENSITY**2)) for angles in VIEWS.values()]
    return sheet([[picture(results, stage, model, view, frame) for view in seen_from]], (), tuple(VIEWS))


def silhouette_sheet(results: Results, frames: Sequence[int], width: int = 250 * DENSITY) -> np.ndarray | None:
    """Return the silhouettes of all cameras, drawn over the images where the capture is at hand; None without any."""
    cameras = results.silhouette_cameras
    if not cameras or not frames:
        return None

    def row(camera: str) -> list[np.ndarray | None]:
        pictures: list[np.ndarray | None] = []
        masks = {frame: results.silhouette(camera, frame) for frame in frames}
        left, top, w, h = _subject_window([mask for mask in masks.values() if mask is not None])
        part = np.s_[top : top + h, left : left + w]
        for frame, whole in masks.items():
            if whole is None:
                pictures.append(None)
                continue
            mask = whole[part]
            size = shown_size((left, top, w, h), whole.shape[::-1], width)
            if results.capture is not None:
                below = faded(resize(results.capture.frame(camera, frame)[part], size), 0.25)
            else:
                below = np.full((size[1], size[0], 3), 245, np.uint8)
            drawn = outlined(below, mask, (214, 40, 90), 0.30)
            covered = 100 * float((whole > 127).mean())
            corner = (6 * DENSITY, size[1] - 6 * DENSITY)
            pictures.append(
                write_on(drawn, f"{covered:.1f} %", corner, 11 * DENSITY, anchor="lb", plate=(255, 255, 255))
            )
        return pictures

    with threads() as executor:
        rows = list(map_items(row, list(cameras), executor))
    labels = [f"frame {f}" for f in frames]
    if len(cameras) <= 4:
        return sheet(rows, cameras, labels, framed=True)
    half = (len(cameras) + 1) // 2  # two columns of cameras keep the page short
    count = max(1, len(frames) // 2)
    short = [r[:: max(1, len(frames) // count)][:count] for r in rows]
    labels = labels[:: max(1, len(frames) // count)][:count]
    labelled = [[None if p is None else _named(p, camera) for p in r] for camera, r in zip(cameras, short, strict=True)]
    pairs = [labelled[i] + (labelled[i + half] if i + half < len(labelled) else []) for i in range(half)]
    return sheet(pairs, (), labels * 2, framed=True)


def _subject_window(masks: Sequence[np.ndarray]) -> tuple[int, int, int, int]:
    """Window of a camera's image around what its silhouettes (H, W) cover together; see `window_around`."""
    if not masks:
        return 0, 0, 0, 0
    covered = np.any([mask > 127 for mask in masks], axis=0)
    return window_around(np.argwhere(covered)[:, ::-1] + 0.5, covered.shape[::-1])


def _named(image: np.ndarray, name: str) -> np.ndarray:
    return write_on(image, name, (7 * DENSITY, 7 * DENSITY), 12 * DENSITY, bold=True, plate=(255, 255, 255))


def overlay(
    results: Results,
    camera: str,
    frame: int,
    model: Model,
    longest_side: int = 420,
    opacity: float = 0.85,
    look: Look | None = None,
    around: np.ndarray | None = None,
) -> np.ndarray:
    """Return a model drawn over a camera's image, distortion included: (H, W, 3) uint8; `around`: see `camera_view`."""
    capture = results.capture
    assert capture is not None
    view = camera_view(capture.rig, capture.rig.names.index(camera), longest_side, around)
    photograph = resize(view.part_of(capture.frame(camera, frame)), view.size)
    return model.render(view, look).over(faded(photograph, 0.35), opacity)


def overlay_sheet(
    results: Results, frames: Sequence[int], build: Builder, opacity: float = 0.85, columns: int = 4
) -> np.ndarray | None:
    """Return geometry drawn over the images of all cameras, around it; None without a calibrated capture."""
    capture = results.capture
    if capture is None or not capture.is_calibrated:
        return None
    built = {f: Model(build(results, f)) for f in frames}
    around = {f: np.concatenate([np.zeros((0, 3)), *(m.vertices for m in model.meshes)]) for f, model in built.items()}
    jobs = [(camera, frame) for frame in frames for camera in capture.cameras]

    def tile(job: tuple[str, int]) -> np.ndarray:
        camera, frame = job
        drawn = overlay(results, camera, frame, built[frame], 340 * DENSITY, opacity, FINE, around[frame])
        return _named(drawn, camera if len(frames) == 1 else f"{camera}, frame {frame}")

    with threads() as executor:
        tiles: list[np.ndarray | None] = list(map_items(tile, jobs, executor))
    columns = min(columns, max(len(capture.cameras), 2))
    return sheet([tiles[i : i + columns] for i in range(0, len(tiles), columns)], framed=True)


def cameras_picture(
    results: Results, stage: ViewStage, frame: int, size: tuple[int, int] = (900 * DENSITY, 560 * DENSITY)
) -> np.ndarray | None:
    """Return the cameras around the subject with their names; None without a calibrated capture."""
    capture = results.capture
    if capture is None or not capture.is_calibrated:
        return None
    rig = capture.rig
    target = stage.centers[min(results.place(frame), len(stage.centers) - 1)]
    distances = np.linalg.norm(rig.centers - target, axis=1)
    depth, thin = 0.16 * float(np.median(distances)), 0.003 * float(np.median(distances))
    wires = [frustum(rig, c, depth, thin, palette.ACCENT) for c in range(len(rig))]
    subject = stage.points + target
    everything = np.concatenate([subject, *(w.vertices for w in wires)])
    wide = ViewStage(everything - target, target[None], stage.up, stage.broad, stage.floor)
    view = wide.view(25.0, 32.0, size, 30.0)
    body = scene.body_skin(results, frame)
    image = render([body, *wires], view, FINE, stage.up).above(floor(wide, view, [body])).clear()
    pixels, _ = view.project(rig.centers)
    for name, (x, y) in zip(rig.names, pixels, strict=True):
        at = (float(x), float(y) - 12 * DENSITY)
        image = write_on(image, name, at, 13 * DENSITY, palette.INK, anchor="mb", plate=(255, 255, 255))
    return image


def camera_images(results: Results, frame: int, width: int = 230 * DENSITY) -> np.ndarray | None:
    """Return one photograph of each camera; None without a capture."""
    capture = results.capture
    if capture is None:
        return None
    tiles: list[np.ndarray | None] = []
    for camera in capture.cameras:
        image = capture.frame(camera, frame)
        scale = width / max(image.shape[:2])
        size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
        tiles.append(_named(fit(image, size), camera))
    columns = min(4, len(tiles))
    return sheet([tiles[i : i + columns] for i in range(0, len(tiles), columns)], framed=True)
