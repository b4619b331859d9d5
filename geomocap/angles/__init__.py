"""Joint angles: anatomical ones of named joints, turns about their own axes of the others."""
