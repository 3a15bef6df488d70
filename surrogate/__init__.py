"""Neural surrogates of the per-vesicle operators of `biem`."""

from surrogate.learned import LearnedMaps
from surrogate.library import load_maps

__all__ = ["LearnedMaps", "load_maps"]
