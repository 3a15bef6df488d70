"""What is read off a suspension: forces and velocities at an instant, observables, fields."""
