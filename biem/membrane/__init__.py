"""Elastic membranes: forces, boundary operators, and the maps that split steppers use."""
