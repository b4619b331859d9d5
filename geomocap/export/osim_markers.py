"""Where the markers of motion.trc sit on OpenSim's own models of persons, as a marker set for scaling and kinematics.

A marker is a joint's centre, and OpenSim's full-body models (Rajagopal et al. 2016, IEEE Trans. Biomed. Eng. 63, 2068)
have their bodies' origins there: hip centres in the thighs' origins, and so on.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as Xml

from geomocap.files.atomic import write_text
from geomocap.naming.found_names import FoundNames
from geomocap.naming.name_sets import read_name_set

VERSION = "40000"


def write_osim_markers(path: Path, found: FoundNames, labels: tuple[str, ...]) -> bool:
    """Write a marker set, whole or not at all; nothing if the subject isn't a person whose left and right are told.

    Parameters
    ----------
    path : Path
    found : FoundNames
    labels : (J,) tuple of str
        What the joints are called in motion.trc.

    Returns
    -------
    bool
        Whether it was written.
    """
    bodies = read_name_set("opensim").origins
    template = found.template
    if template is None or template.name != "human" or not found.sides_known:
        path.unlink(missing_ok=True)
        return False
    document = Xml.Element("OpenSimDocument", Version=VERSION)
    markers = Xml.SubElement(Xml.SubElement(document, "MarkerSet", name="geomocap"), "objects")
    for joint, part in sorted(found.joint_parts.items()):
        side = template.sides[part]
        body = bodies.get(f"{template.parts[part]}_{side}" if side else template.parts[part])
        if body is not None:
            marker = Xml.SubElement(markers, "Marker", name=labels[joint])
            for tag, text in (("socket_parent_frame", f"/bodyset/{body}"), ("location", "0 0 0"), ("fixed", "false")):
                Xml.SubElement(marker, tag).text = text
    Xml.indent(document)
    write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + Xml.tostring(document, encoding="unicode") + "\n")
    return True
