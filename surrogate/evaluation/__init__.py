"""How wrong the learned maps are, and how fast, beside exact maps at few nodes."""

from surrogate.evaluation.run import PARTS, Options, Report, evaluate

__all__ = ["PARTS", "Options", "Report", "evaluate"]
