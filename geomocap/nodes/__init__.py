"""A deformable surface followed on geometry alone: nodes, and rigid parts made of them."""
