"""Names for a run's bodies and joints: the user's, and those of a template that fits."""

from __future__ import annotations

from pathlib import Path

from geomocap.export.conventions import Axis
from geomocap.export.export_settings import ExportSettings
from geomocap.export.names import Names
from geomocap.files.run import Run
from geomocap.model.skeleton import Skeleton
from geomocap.naming.found_names import FoundNames, find_names
from geomocap.naming.given_names import with_given
from geomocap.naming.mean_posture import BodySurface
from geomocap.naming.name_sets import renamed
from geomocap.naming.name_templates import NamingError, built_in_templates, is_template, read_template
from geomocap.subject.subject_model import MODEL_FILE, read_model

NAMES_FOUND = "names_found.toml"


def run_names(run: Run, skeleton: Skeleton, up: Axis, settings: ExportSettings) -> tuple[Names, FoundNames]:
    """Return the names that settings ask for: all of them, and what was found by a template.

    Parameters
    ----------
    run : Run
        Its `names.toml` goes before names that are found.
    skeleton : Skeleton
    up : "x", "y" or "z"
    settings : ExportSettings

    Raises
    ------
    MotionError, NamingError
        If a file of names or a template can't be read.
    """
    own = run.path / "names.toml"
    asked = settings.names
    templates = None
    if asked not in ("auto", "none"):
        if asked not in built_in_templates() and not Path(asked).is_file():
            raise NamingError(
                f"{asked}: no names and no template; expected auto, none, {', '.join(built_in_templates())} or a file"
            )
        if not is_template(asked):
            return Names.read(Path(asked)), FoundNames()
        templates = [read_template(asked)]
    names = Names.read(own) if own.is_file() else Names()
    if asked == "none":
        return names, FoundNames()
    found = find_names(skeleton, "xyz".index(up), surface_of_bodies(run, skeleton), templates)
    known = templates or [read_template(name) for name in built_in_templates()]
    plain = with_given(found, names.bodies, skeleton, "xyz".index(up), known)
    # what the user called by a template's word gets the other program's word for it
    others = {b: n for b, n in names.bodies.items() if plain is found or plain.bodies.get(b) != n}
    found = renamed(plain, settings.name_set)
    return Names(others, names.joints, names.source).over(found.bodies, found.joints), found


def surface_of_bodies(run: Run, skeleton: Skeleton) -> BodySurface | None:
    """Return the surface of the run's model with its bodies, in the first frame; None without a model of these."""
    if not (run.path / MODEL_FILE).is_file():
        return None
    model = read_model(run.path / MODEL_FILE)
    return BodySurface(model.points, model.skin.body) if model.body_count == skeleton.body_count else None


def names_text(found: FoundNames) -> str:
    """Write found names down as `names.toml` has them, each with its confidence."""
    template = found.template.name if found.template else "none"
    sides = "" if found.sides_known else "; left and right not told: sides are a and b"
    lines = [f"# named as {template}{sides}; copy to names.toml to change them"]
    lines += [f"# no {joint}: both its parts are in {body}" for joint, body in found.unparted.items()]
    lines += [f'"{name}" = {b}  # {found.confidence[b]:.2f}' for b, name in found.bodies.items()]
    lines += ["", "[joints]"]
    lines += [f'"{name}" = {j}  # {found.joint_confidence[j]:.2f}' for j, name in found.joints.items()]
    return "\n".join(lines) + "\n"
