"""Motion of surfaces: nodes followed on geometry without texture, patches followed in images, and their paths."""
