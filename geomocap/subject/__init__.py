"""The subject's own model: made from a sequence, found in another one, followed there."""
