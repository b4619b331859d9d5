"""Captures in: synthesize from animated glTF, import from other tools."""

import geomocap as geomocap  # it says where compiled kernels are kept, before there are any
