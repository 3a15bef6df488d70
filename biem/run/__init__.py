"""The loop, its files, pictures and checks."""
