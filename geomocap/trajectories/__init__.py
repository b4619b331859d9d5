"""What is done to trajectories, whatever made them: filters, smoothing, gaps, choice."""
