"""Captures in: synthesize from animated glTF, import from other tools."""
