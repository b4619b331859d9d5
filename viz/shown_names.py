"""Names of bodies and joints as pages show them: the same as in the run's motion files."""

from __future__ import annotations

from geomocap.export.names import Names
from geomocap.model.skeleton import Skeleton
from viz.run_contents import Results


def names_of(results: Results) -> Names:
    """Return the names of a run's bodies and joints, `RUN/names.toml`; none if there is no such file."""
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
