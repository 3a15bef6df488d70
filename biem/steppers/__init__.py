"""Time steps of a suspension."""
