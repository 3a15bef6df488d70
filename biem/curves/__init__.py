"""Closed curves by their nodes: Fourier calculus, geometry, shapes, redistribution, corrections."""
