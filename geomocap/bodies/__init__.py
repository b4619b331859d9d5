"""Rigid bodies found from motion paths. It sees paths only, never what followed them."""
