"""What can go wrong, each with one line that says what, where and how to mend it."""

import unicodedata

LONGEST = 1000  # characters of a message


def harmless(text: str) -> str:
    r"""Write what a terminal or page would obey as `\x1b`: control characters, turned directions, broken UTF-8."""
    return "".join(c if c.isprintable() or c in "\n\t" else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    if unicodedata.category(character) == "Zs":  # unusual spaces are harmless
        return character
    return character.encode("unicode_escape").decode("ascii")


def shortened(text: str, most: int = 80) -> str:
    """Return a text, without its middle if it is long."""
    return text if len(text) <= most else f"{text[: most // 2]} … {text[-most // 2 :]}"


class GeomocapError(Exception):
    """Base of all errors that a user can cause and mend; its text is one clear line, whatever is named in it."""

    def __str__(self) -> str:
        return shortened(harmless(" ".join(super().__str__().split())), LONGEST)


class CaptureError(GeomocapError):
    """A capture folder that can't be used as it is."""


class CalibrationError(GeomocapError):
    """Cameras that are missing, contradict the images, or could not be determined."""


class SettingsError(GeomocapError):
    """A setting that is unknown, of the wrong type or out of range."""


class RunError(GeomocapError):
    """A run folder that can't be read, written or continued."""


class GeometryError(GeomocapError):
    """Geometry from which a result can't be had: empty, outside the volume, too small."""
