"""Near-singular integration: S[f] along three normals to a deformed vesicle, f = (sin, cos), by several schemes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from biem.curves.curve import length, normal
from biem.curves.fourier import resample
from biem.curves.shapes import perturbed
from biem.membrane.maps import LAYERS
from biem.stokes.near_layers import NearLayers, exact_layers
from biem.stokes.near_search import find_near
from biem.stokes.single_layer import single_layer
from reproductions.pictures import figure, outlines, save
from reproductions.study import Results, Study, table, write_results
from surrogate import load_maps

NAME = "near"
SEED, REDUCED_AREA = 18, 0.65
POINTS = (32, 128)
CONVERGED = 1 << 17  # nodes: their trapezoid rule errs by exp(-2 pi CONVERGED d / length) at the distance d
REACH, TARGETS = 1.5, 200  # in h; an even number along a normal: none of them on the curve
FEET = (2, 13, 24)  # nodes of 32 that the normals stand on
OUTSIDE = (0.0, 0.5, 1.0)  # offsets of three layers
CLOSE = 1e-2  # h: from each seam (the membrane, d = h and -h) of two targets across it, whose errors are compared
Scheme = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # of X (1, 2, N), f and targets (P, 2): velocities (P, 2)
Layers = Callable[[np.ndarray, np.ndarray], np.ndarray]


def by_layers(method: str, offsets: tuple[float, ...], layers: Layers) -> Scheme:
    """Trapezoid rule beyond h, interpolation of the values on layers within it."""

    def velocity(X: np.ndarray, f: np.ndarray, targets: np.ndarray) -> np.ndarray:
        u = single_layer(X, f, targets, near_field="none", far_field="direct")
        pairs = find_near(X, targets, max(offsets))
        return np.asarray(NearLayers.build(X, targets, pairs, 1.0, method, layers, offsets).add(u, f))

    return velocity


def schemes(points: int) -> dict[str, Scheme]:
    """All, by name; those by networks at 32 nodes alone."""

    def exact(offsets: tuple[float, ...]) -> Layers:
        return lambda X, f: exact_layers(X, f, 1.0, offsets, 1e-8)

    found: dict[str, Scheme] = {
        "adaptive upsampling": lambda X, f, targets: single_layer(X, f, targets, near_field="upsample", far_field="direct"),
        "Ying-Zorin": lambda X, f, targets: single_layer(X, f, targets, near_field="ying_zorin", far_field="direct"),
        "five layers, RBF": by_layers("layers_rbf", LAYERS, exact(LAYERS)),
        "five layers, one-sided": by_layers("layers", LAYERS, exact(LAYERS)),
        "three layers outside, RBF": by_layers("layers_rbf", OUTSIDE, exact(OUTSIDE)),
        "trapezoid rule": lambda X, f, targets: single_layer(X, f, targets, near_field="none", far_field="direct"),
    }
    if points == 32:
        for kind in ("mlp", "ivnet"):
            layers = load_maps(kind, slots=["near"]).near_layers
            found[f"five layers, RBF, by {kind}"] = by_layers("layers_rbf", LAYERS, layers)
            found[f"five layers, one-sided, by {kind}"] = by_layers("layers", LAYERS, layers)
    return found


def lines(X: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Targets (3, D, 2) at distances d (D,), in h, along the normals of the curve X (1, 2, N)."""
    feet = [foot * X.shape[-1] // 32 for foot in FEET]
    h = float(length(X)[0]) / X.shape[-1]
    return X[0, :, feet][:, None, :] + (h * d)[None, :, None] * normal(X)[0, :, feet][:, None, :]


def force(points: int) -> np.ndarray:
    """(sin, cos) of the parameter (1, 2, N)."""
    theta = 2.0 * np.pi * np.arange(points) / points
    return np.stack([np.sin(theta), np.cos(theta)])[None]


def converged(X: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """S at targets (P, 2), by the trapezoid rule on so many nodes of the same curve that it resolves the nearest ones."""
    return single_layer(resample(X, CONVERGED), force(CONVERGED), targets, near_field="none", far_field="direct")


def measure(study: Study) -> Results:
    """Computes everything anew: it takes seconds."""
    folder = study.folder(NAME)
    d = (np.arange(TARGETS) + 0.5) / TARGETS * 2.0 * REACH - REACH
    tables: Results = {}
    curves: dict[int, tuple[np.ndarray, dict[str, np.ndarray]]] = {}
    for points in POINTS:
        X, f = perturbed(points, REDUCED_AREA, seed=SEED)[None], force(points)
        targets = lines(X, d).reshape(-1, 2)
        seams = np.add.outer((-1.0, 0.0, 1.0), (-CLOSE, CLOSE)).ravel()  # h
        across = lines(X, seams).reshape(-1, 2)
        expected, expected_across = converged(X, targets), converged(X, across)
        scale = float(np.linalg.norm(expected, axis=1).max())
        curves[points] = X, {"converged": expected}
        tables[str(points)] = {}
        within = np.tile(np.abs(d) <= 1.0, len(FEET))
        outside = np.tile(d > 0, len(FEET))
        for name, scheme in schemes(points).items():
            u = scheme(X, f, targets)
            curves[points][1][name] = u
            error = np.linalg.norm(u - expected, axis=1) / scale
            jump = (scheme(X, f, across) - expected_across).reshape(-1, 2, 2)
            tables[str(points)][name] = {
                "outside": float(error[within & outside].max()),
                "inside": float(error[within & ~outside].max()),
                "beyond": float(error[~within].max()),
                "jump": float(np.linalg.norm(jump[:, 1] - jump[:, 0], axis=1).max() / scale),
            }
    pictures = [_picture(curves[32][0], curves[32][1], d, folder / "near.png")]
    return write_results(study, NAME, {"tables": tables, "pictures": pictures})


def _picture(X: np.ndarray, found: dict[str, np.ndarray], d: np.ndarray, path: Path) -> str:
    """The curve with its normals, and |u| along each."""
    made, axes = figure(14.0, 4.2, 1, 4, width_ratios=[1.5, 1.0, 1.0, 1.0])
    axes[0, 0].plot(*outlines(X)[0], color="black")
    h = float(length(X)[0]) / X.shape[-1]
    for layer in LAYERS:
        axes[0, 0].plot(*outlines(X + layer * h * normal(X))[0], color="0.8", lw=0.5)
    ends = lines(X, np.array([-REACH, REACH]))
    scale = np.linalg.norm(found["converged"], axis=1).max()
    styles = {"converged": ("black", 3.0), "Ying-Zorin": ("tab:purple", 1.0), "five layers, RBF": ("tab:orange", 1.2)}
    styles |= {"five layers, one-sided": ("tab:green", 1.2), "three layers outside, RBF": ("tab:red", 1.0), "trapezoid rule": ("0.6", 1.0)}
    styles |= {"adaptive upsampling": ("tab:cyan", 1.0)}
    for k, (a, b) in enumerate(ends):
        axes[0, 0].plot([a[0], b[0]], [a[1], b[1]], color="tab:red")
        axes[0, 0].annotate(str(k + 1), b, color="tab:red")
        panel = axes[0, k + 1]
        for name, u in found.items():
            if name not in styles:
                continue
            size = np.linalg.norm(u.reshape(len(FEET), len(d), 2)[k], axis=1) / scale
            panel.plot(d, size, color=styles[name][0], lw=styles[name][1], label=name)
        wanted = np.linalg.norm(found["converged"].reshape(len(FEET), len(d), 2)[k], axis=1) / scale
        margin = 0.6 * np.ptp(wanted) + 0.05
        panel.set(title=f"normal {k + 1}", xlabel="distance / h", ylim=(wanted.min() - margin, wanted.max() + margin))
        panel.axvline(0.0, color="0.8", lw=0.8)
        panel.grid(alpha=0.3)
    axes[0, 0].set(aspect="equal", title="N = 32, layers and normals")
    axes[0, 1].set_ylabel("|velocity| / its largest")
    made.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside lower center", ncols=len(styles), fontsize=8)
    return save(made, path)


def section(results: Results) -> str:
    """Statement, finding, difference."""
    text = []
    for points, rows in results["tables"].items():
        text.append(f"N = {points}:")
        lines_ = [[name, r["outside"], r["inside"], r["jump"], r["beyond"]] for name, r in rows.items()]
        text.append(table(["scheme", "outside, d <= h", "inside, d <= h", "jump", "h < d <= 1.5 h"], lines_))
    few = results["tables"]["32"]
    rbf, one_sided, three = few["five layers, RBF"], few["five layers, one-sided"], few["three layers outside, RBF"]
    worst = lambda row: max(row["inside"], row["outside"])
    text.append(
        "Errors over the largest velocity on the three normals, the largest of each; the jump is of the error, across the membrane, d "
        "= h or -h. "
        f"At N = 32, without the two inner layers the RBF errs {worst(three) / worst(rbf):.2g} times as much as with them, and jumps by "
        f"{three['jump']:.1e}; the one-sided interpolation of the same five layers errs {worst(one_sided):.1e} where the RBF across "
        f"the membrane "
        f"errs {worst(rbf):.1e}."
    )
    for kind in ("mlp", "ivnet"):
        own, same = few[f"five layers, one-sided, by {kind}"], few[f"five layers, RBF, by {kind}"]
        text.append(f"With layers by {kind}: one-sided {worst(own):.1e}, RBF {worst(same):.1e}.")
    return "\n\n".join(
        [
            "**The paper**: five layers give a velocity that is continuous across the membrane and close to Ying-Zorin's, three outer "
            "ones alone a wrong one "
            "inside and a jump; the direct sum diverges.",
            f"**Found** (`shapes.perturbed`, seed {SEED}; converged: {CONVERGED} nodes of the same curve):",
            *text,
            f"**Why they differ**: the paper's reference is Ying-Zorin's scheme, which itself errs by {worst(few['Ying-Zorin']):.1e} "
            f"at N = 32. An RBF across "
            "the membrane smooths the kink that the velocity has there (its normal derivative jumps by the tangential force); "
            "polynomials on each side do not.",
        ]
    )
