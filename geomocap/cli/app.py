"""The commands by name; the module of a command is imported when the command is called."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from geomocap.cli.console import console
from geomocap.cli.usage import usage_in_one_line
from geomocap.version import __version__

# name: where the command is, and what it does in the words of its own help
COMMANDS = {
    "silhouettes": ("stage_commands.silhouettes", "Cut the subject out of all images."),
    "voxels": (
        "stage_commands.voxels",
        "Carve the surface voxels of all frames, silhouettes first where they are missing.",
    ),
    "cloud": (
        "stage_commands.cloud",
        "Measure the surface by least squares matching: a dense point cloud for each frame.",
    ),
    "track": (
        "stage_commands.track",
        "Follow points of the surface through all frames: trajectories with velocities and accelerations.",
    ),
    "segment": (
        "stage_commands.segment",
        "Segment any sequence of scans into rigid bodies, joints and motion; one scan gets its ellipsoids.",
    ),
    "run": ("stage_commands.run", "Do everything: from a capture to bodies, skeleton, motion files and report."),
    "review": ("picture_commands.review", "Make the pictures and the report of a run anew, from its files."),
    "render": ("picture_commands.render", "Draw any geometry from four sides into a PNG, without a screen."),
    "synthesize": (
        "capture_commands.synthesize",
        "Synthesize a multi-camera capture with ground truth from an animated glTF.",
    ),
    "import": ("capture_commands.import_", "Turn another tool's session into a capture."),
    "demo": (
        "demo_command.demo",
        "Synthesize a small capture of the built-in figure and take it all the way to the report.",
    ),
    "calibrate": (
        "calibrate_command.calibrate",
        "Calibrate the cameras of a capture with a reference bar; writes CAPTURE/sparse and a report.",
    ),
    "convert-calibration": (
        "capture_commands.convert",
        "Convert a calibration between the formats of aniposelib, caliscope, Pose2Sim, OpenCV, EasyMocap and COLMAP.",
    ),
    "keypoints": (
        "keypoint_command.keypoints",
        "Follow key-points on the surface, given as `[[keypoint]]` tables: name, center (m), radius (m), frame.",
    ),
    "view": (
        "view_command.view",
        "Look at a run, capture, scans, calibration or motion file in the browser; needs the extra view.",
    ),
    "export": (
        "export_command.export",
        "Write motion files of a run for Blender, OpenSim, C3D tools, game engines and plots.",
    ),
    "evaluate": (
        "evaluate_command.evaluate",
        "Compare a run with the truth: lengths in mm unless a name says otherwise, `%h` is per cent of the height.",
    ),
    "info": (
        "info.info",
        "Say what a capture, run, calibration, truth, motion file or scans hold, what is wrong, and what is doubtful.",
    ),
}
_LOOK: dict[str, Any] = {
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": "markdown",
    "context_settings": {"help_option_names": ["-h", "--help"]},
}


def load(name: str) -> Any:
    """Import a command's module and return the command with its options."""
    from geomocap.cli.settings_options import command_class

    module, _, function = COMMANDS[name][0].rpartition(".")
    called = getattr(import_module(f"geomocap.cli.{module}"), function)
    alone = typer.Typer(**_LOOK)
    alone.command(name, cls=command_class(called))(called)
    return typer.main.get_command(alone)


class _Commands(TyperGroup):
    """The commands, each a name and a line of help until it is called."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands.update({name: TyperCommand(name, help=text) for name, (_, text) in COMMANDS.items()})

    def make_context(self, info_name: str | None, args: list[str], *rest: Any, **extra: Any) -> Any:
        if not args:
            return super().make_context(info_name, args, *rest, **extra)  # tells the help
        with usage_in_one_line():
            return super().make_context(info_name, args, *rest, **extra)

    def invoke(self, ctx: Any) -> Any:
        with usage_in_one_line(ctx):
            return super().invoke(ctx)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] in COMMANDS:
            self.commands[args[0]] = load(args[0])
        return super().resolve_command(ctx, args)


app = typer.Typer(
    name="geomocap",
    cls=_Commands,
    help="Motion capture without markers and without a body model, from the geometry alone.",
    no_args_is_help=True,
    **_LOOK,
)


def _version(wanted: bool) -> None:
    if wanted:
        console.print(f"geomocap {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Motion capture without markers and without a body model, from the geometry alone."""
