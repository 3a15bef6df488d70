"""Training data for `surrogate` from simulations with `biem`."""
