"""Reference-bar calibration and the calibrations of other tools."""
