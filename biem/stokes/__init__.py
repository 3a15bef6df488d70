"""Stokes flow of forces on curves: kernels, singular and near-singular quadrature, pair sums."""
