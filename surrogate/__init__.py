"""Neural surrogates of the per-vesicle operators of `biem`."""
