"""Names of bodies and joints: which known kind of skeleton a found one is."""
