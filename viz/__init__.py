"""Pictures out: offscreen renderings, plots, the report page."""
