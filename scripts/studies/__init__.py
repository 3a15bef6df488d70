"""What the scripts that compare solvers share: rungs of the ladder, runs kept with what they cost, distances between them."""
