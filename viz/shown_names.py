"""Names of bodies and joints as pages show them: the same as in the run's motion files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import tomli_w

from geomocap.errors import GeomocapError, RunError
from geomocap.export.export_errors import MotionError
from geomocap.export.names import Names
from geomocap.export.run_export import run_settings, run_up
from geomocap.export.run_names import NAMES_FOUND, run_names
from geomocap.files.atomic import write_text
from geomocap.model.skeleton import Skeleton
from viz.run_contents import Results


def names_of(results: Results) -> Names:
    """Return the names of a run's bodies and joints: the user's, and for what these leave unnamed those found."""
    own, found = users_names(results), Names()
    file = results.run.path / NAMES_FOUND
    if file.is_file():
        found = Names.read(file)
    return own.over(found.bodies, found.joints)


def named(results: Results) -> Results:
    """Return a run whose bodies and joints are called as in its motion files; by number if the names can't be used."""
    try:
        renamed = replace(results, names=names_of(results))
        _ = renamed.skeleton
    except MotionError:
        return results
    return renamed


def users_names(results: Results) -> Names:
    """Return the names that the user gave, `RUN/names.toml`; none if there is no such file."""
    file = results.run.path / "names.toml"
    return Names.read(file) if file.is_file() else Names()


def body_names(results: Results, skeleton: Skeleton) -> tuple[str, ...]:
    """Return the names of all bodies, by number."""
    return names_of(results).body_names(skeleton.body_count, skeleton.body_names)


def joint_names(results: Results, skeleton: Skeleton) -> tuple[str, ...]:
    """Return the names of all joints, by number."""
    names = names_of(results)
    bodies = names.body_names(skeleton.body_count, skeleton.body_names)
    return names.joint_names(skeleton.joint_bodies, bodies, skeleton.joint_names)


def trunk_of(results: Results, skeleton: Skeleton) -> int | None:
    """Return the body that the motion files' tree grows from; None: that of the skeleton."""
    try:
        return run_names(results.run, skeleton, run_up(results.run), run_settings(results.run))[1].trunk
    except GeomocapError:
        return None  # told where motion files are written


def rename(results: Results, kind: str, number: int, name: str) -> Path:
    """Give a body or joint another name in `RUN/names.toml`; an empty one takes its name away.

    Parameters
    ----------
    results : Results
    kind : "body" or "joint"
    number : int
    name : str

    Returns
    -------
    Path
        The file.

    Raises
    ------
    MotionError
        If the name can't be used, or is that of another body or joint.
    RunError
        If the file can't be written.
    """
    file, skeleton = results.run.path / "names.toml", results.skeleton
    if skeleton is None:
        raise RunError(f"{results.run.path}: has no bodies that could be named")
    before = users_names(results)
    bodies, joints = dict(before.bodies), dict(before.joints)
    (bodies if kind == "body" else joints).pop(number, None)
    if name:
        (bodies if kind == "body" else joints)[number] = name
    for group in (bodies, joints):
        twice = [n for n in group.values() if list(group.values()).count(n) > 1]
        if twice:
            raise MotionError(f"{twice[0]}: another one has this name; give each its own")
    after = Names(bodies, joints, str(file))
    called = after.body_names(skeleton.body_count, skeleton.body_names)
    after.joint_names(skeleton.joint_bodies, called, skeleton.joint_names)
    tables = {"bodies": {n: b for b, n in bodies.items()}, "joints": {n: j for j, n in joints.items()}}
    write_text(file, tomli_w.dumps({key: table for key, table in tables.items() if table}))
    return file
