"""Settings of node tracking."""

from __future__ import annotations

from pydantic import Field

from geomocap.settings import Settings


class NodeTrackingSettings(Settings):
    """How nodes of a surface are followed through point sets."""

    nodes: int = Field(1000, ge=20, le=100000, description="nodes to follow", json_schema_extra={"flag": "nodes"})
    coarse_nodes: int = Field(220, ge=10, le=20000, description="nodes of the coarse graph that finds the motion first")
    points: int = Field(5000, ge=100, le=1000000, description="points of a frame that are used (points)")
    coarse_points: int = Field(
        1800, ge=100, le=1000000, description="points of a frame that the coarse graph is fitted to (points)"
    )
    neighbours: int = Field(9, ge=4, le=60, description="neighbours that make a point's normal")
    stiffness: float = Field(
        0.1, gt=0, description="resistance to bending and stretching, relative to the points' pull"
    )
    fine_stiffness: float = Field(1.5, gt=0, description="the same for the fine graph")
    image_stiffness: float = Field(
        1.0, gt=0, description="the same for the usual edge of the fine graph where images guide it"
    )
    normal_weight: float = Field(1.0, ge=0, description="weight of normals against positions when points are matched")
    give: float = Field(0.3, gt=0, description="strain at which an edge gives way (fraction of its length)")
    strain_cost: float = Field(1.0, ge=0, description="cost of strain relative to that of unexplained points")
    inertia_cost: float = Field(
        0.3, ge=0, description="cost of a motion that doesn't go on, relative to unexplained points"
    )
    point_weight: float = Field(0.05, ge=0, le=1, description="pull along the surface relative to that across it")
    colors: bool = Field(
        True,
        description="whether the points' colours guide the nodes, where there are any",
        json_schema_extra={"flag": "node-colors"},
    )
    feature_weight: float = Field(1.0, ge=0, description="pull of features (colours) relative to that of the geometry")
    anchor_weight: float = Field(
        4.0, ge=0, description="pull of a trajectory that is known from the images relative to that of a point"
    )
    feature_scale: float = Field(0.3, gt=0, description="difference of features that separates points")
    momentum: float = Field(0.9, ge=0, le=1, description="fraction of the last motion that is expected to go on")
    end_reach: float = Field(0.25, ge=0, description="limbs' ends are looked for within (fraction of the diagonal)")
    lost_below: float = Field(
        0.1, ge=0, le=1, description="support by a frame's points below which a node is lost (fraction)"
    )
    slide: float = Field(0.5, gt=0, description="standard deviation of a sliding that can't be seen (node spacings)")
    noise: float = Field(
        0.05, gt=0, description="least standard deviation of a node across the surface (node spacings)"
    )
    part_rounds: int = Field(
        2,
        ge=0,
        le=2,
        description="scans: rounds in which rigid parts are registered as a whole; 0: the surface stays a skin, as "
        "that of a capture's volume always does",
    )
    part_misfit: float = Field(
        0.07, gt=0, description="points may miss two pieces of a part by this much more than each alone (node spacings)"
    )
    part_fraction: float = Field(0.01, gt=0, lt=0.5, description="smallest rigid part (fraction of the nodes)")
    seed: int = Field(0, ge=0, description="seed of the thinning of points")
