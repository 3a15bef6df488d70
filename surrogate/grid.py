"""Grid search over an IVNet's blocks n_b, width w and levels L: variants of a training, and the table of what they reach."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path

from surrogate.config import Training
from surrogate.weights import read_weights


def variants(config: Training, blocks: str, widths: str, levels: str) -> dict[str, Training]:
    """Trainings by their names, as "b2-w32-l2". Values are given as "1,2,4". Raises ValueError."""
    chosen = {}
    for b, w, level in product(*(_numbers(*item) for item in (("--blocks", blocks), ("--widths", widths), ("--levels", levels)))):
        network = config.network.model_copy(update={"arch": "ivnet", "blocks": b, "width": w, "levels": level})
        chosen[f"b{b}-w{w}-l{level}"] = config.model_copy(update={"network": network})
    return chosen


def _numbers(option: str, text: str) -> list[int]:
    try:
        numbers = [int(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < 1:
        raise ValueError(f'{option} {text}: expected whole numbers from 1, as in "1,2,4"')
    return numbers


def grid_table(output: Path, chosen: Mapping[str, Training]) -> str:
    """Markdown: of every finished variant its parameters, seconds and errors on test runs, the best first."""
    rows = []
    for label in chosen:
        for path in sorted((output / label).rglob("weights.safetensors")):
            network, card = read_weights(path)
            size = sum(p.numel() for p in network.core.parameters())
            settings = card.network.network
            (errors,) = card.errors.values()
            shape = (settings["blocks"], settings["width"], settings["levels"])
            rows.append((errors["mean"], *shape, size, card.samples, card.seconds, errors["median"], errors["p95"]))
    lines = ["| n_b | w | L | parameters | samples | seconds | median | mean | 95 % |", "|---|---|---|---|---|---|---|---|---|"]
    for mean, b, w, level, size, samples, seconds, median, p95 in sorted(rows):
        lines.append(f"| {b} | {w} | {level} | {size:,} | {samples:,} | {seconds:.0f} | {median:.2%} | {mean:.2%} | {p95:.2%} |")
    return "\n".join(lines)
