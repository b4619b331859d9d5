"""What can go wrong, each with one line that says what, where and how to mend it."""


class GeomocapError(Exception):
    """Base of all errors that a user can cause and mend; its text is one clear line."""


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
