"""Motion over time: joint angles, each with its band of confidence, turns of joints or of a single body, bones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from geomocap.angles.angle_set import AngleSet
from viz.body_colors import body_color, hex_color
from viz.desk import Desk
from viz.figures import WIDTH, body_motion, bone_lengths, figure_of, joint_angles, plot
from viz.quality_figures import Bone
from viz.report import Block, text
from viz.run_contents import Results
from viz.shown_angles import angles_of

COLUMNS = 3
MIDDLE = {"left": 0, "right": 1, "a": 0, "b": 1}


@plot
def angle_sheet(angles: AngleSet) -> Figure:
    """Plot all angles, those of the two sides in one field; the band is twice the standard deviation.

    The size of what turns about other axes than a joint's own isn't drawn.
    """
    fields: dict[str, list[int]] = {}
    for k, name in enumerate(angles.names):
        if not name.endswith("_off_axis"):
            words = [w for w in name.split("_") if w not in MIDDLE]
            fields.setdefault(" ".join(words), []).append(k)
    rows = max(1, -(-len(fields) // COLUMNS))
    figure = figure_of(WIDTH, 1.5 * rows + 0.3)
    axes = np.atleast_1d(figure.subplots(rows, COLUMNS, sharex=True, squeeze=False)).ravel()
    times = np.arange(len(angles.values)) / angles.fps
    for ax, (title, numbers) in zip(axes, fields.items(), strict=False):
        for k in numbers:
            side = next((w for w in angles.names[k].split("_") if w in MIDDLE), "")
            color = hex_color(body_color(MIDDLE.get(side, 2)))
            value, band = angles.values[:, k], 2 * np.nan_to_num(angles.std[:, k])
            ax.fill_between(times, value - band, value + band, color=color, alpha=0.25, lw=0)
            ax.plot(times, value, color=color, label=side or None)
        ax.set_title(title)
        if len(numbers) > 1:
            ax.legend(fontsize=7, loc="upper right")
    for ax in axes[len(fields) :]:
        ax.set_visible(False)
    for ax in axes[max(0, len(fields) - COLUMNS) : len(fields)]:
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("time (s)")
    for ax in axes[::COLUMNS]:
        ax.set_ylabel("degrees")
    return figure


def angle_blocks(results: Results, desk: Desk) -> list[Block]:
    """Return what a report says of names and joint angles."""
    found = angles_of(results)
    if found is None or not found[0].names:
        desk.steps.step()
        return [] if found is None else [text(found[1])]
    words = (
        "As in angles.csv: flexion, adduction and rotation of named joints, zero where limbs are straight; the turn "
        "about its own axis of any other joint, zero in the first frame. Bands: twice the standard deviation by the "
        "scatter of the surface; what the surface slides over the bones isn't in them."
    )
    return [text(found[1]), *desk.plot("angles", angle_sheet(found[0]), "Joint angles", words)]


def motion_blocks(results: Results, bones: Sequence[Bone], desk: Desk) -> list[Block]:
    """Return plots of how far joints, or a single body, have turned since the first frame, and of bones' lengths."""
    skeleton = results.skeleton
    if skeleton is None or skeleton.frame_count < 2:
        return []
    if not skeleton.joint_count:
        words = "Turn and way of the whole body, as in the motion files. Smooth curves are good."
        return desk.plot("motion", body_motion(skeleton, results.fps), "Motion since the first frame", words)
    words = (
        "How far each joint has turned since the first frame, in its body's colour; thin lines: the rotation "
        "vector's parts about the parent's axes. Smooth curves are good."
    )
    turned = joint_angles(skeleton, results.fps)
    blocks = desk.plot("joint_angles", turned, "Turns since the first frame", words)
    if bones:
        words = "Bones don't grow: what differs from zero is error of the joints."
        blocks += desk.plot("bone_lengths", bone_lengths(bones, results.fps), "Bone lengths", words)
    return blocks
