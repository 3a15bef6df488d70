"""How long a process of the tests may take before it counts as hanging: many times what it takes where other work keeps the cores busy."""

LIMIT = 300  # s
