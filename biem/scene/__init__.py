"""Scene files, background flows, and what a scene requires."""
