"""Many vesicles without overlap: a regular grid, or a random packing by hard-particle Monte Carlo moves.

Shapes are (M, 2, N) about the origin with their long axis along x; boxes are (width, height) with the corner at the origin.
"""

from __future__ import annotations

import numpy as np
import shapely
from scipy import optimize
from scipy.spatial import cKDTree

from biem.curves.crossing import polygons
from biem.curves.shapes import place

CORNERS, CORNERS_OF_MANY, MANY = 512, 128, 200  # of the polygons that are moved; those of more than MANY vesicles have fewer
MOVES = 60  # accepted or not, of each vesicle
MOST_MOVES = 2000
LARGEST_TURN = 1.5  # rad
LARGEST_GROWTH = 1.1


def grid(shapes: np.ndarray, box: tuple[float, float], gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres (M, 2) and angles (M,) of a grid with at least `gap` between neighbours.

    Raises ValueError, naming the largest count that fits, if the box is too small.
    """
    M = shapes.shape[0]
    cell = np.ptp(shapes, axis=2).max(axis=0) + gap
    fits = np.floor((np.asarray(box) + 1e-12) / cell).astype(int)
    if fits.prod() < M:
        raise ValueError(
            f"{M} vesicles of {cell[0] - gap:.3g} x {cell[1] - gap:.3g} with gaps of {gap:g} do not fit into a box of "
            f"{box[0]:g} x {box[1]:g}: at most {fits.prod()} do; enlarge the box or lower count, area_fraction or gap"
        )
    # fewest columns and rows that hold M, as evenly stretched as they can be
    options = [(nx, -(-M // nx)) for nx in range(1, fits[0] + 1) if -(-M // nx) <= fits[1]]
    nx, ny = min(options, key=lambda n: abs(np.log((box[0] / n[0] / cell[0]) / (box[1] / n[1] / cell[1]))))
    k = np.arange(M)
    spread = np.floor(k * (nx * ny) / M).astype(int)  # leave holes evenly
    centers = np.stack([(spread % nx + 0.5) * box[0] / nx, (spread // nx + 0.5) * box[1] / ny], axis=1)
    return centers, np.zeros(M)


def random_packing(
    shapes: np.ndarray,
    box: tuple[float, float],
    gap: float,
    rng: np.random.Generator,
    region: shapely.Polygon | None = None,
    periodic: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (M, 2) and angles (M,) of a random packing inside the box, no two membranes closer than `gap`.

    region: a part of the box to stay in, no closer to its boundary than `gap`. periodic: the box repeats itself; centres are in it,
    membranes may reach over its sides, and keep the gap to all images.

    Starts from randomly turned vesicles, small enough to turn freely on a square grid; every move may also grow its vesicle, up to full
    size. One vesicle in every other cell of a checkerboard moves at a time: moves in different cells cannot meet. Raises ValueError
    where full size is not reached.
    """
    M = len(shapes)
    width = np.asarray(box, dtype=np.float64)
    radius = float(np.sqrt((shapes**2).sum(axis=1)).max())
    claimed = float(np.mean(shapely.area(shapely.buffer(polygons(shapes), 0.5 * gap))))  # no two may meet in this
    where, room_area = f"the box of {box[0]:g} x {box[1]:g}", float(width.prod())
    if region is not None:
        where, room_area = "the fluid between the walls", float(region.area)
    if M * claimed > room_area:
        raise ValueError(
            f"{M} vesicles do not fit: with half of the gap of {gap:g} around each they cover {M * claimed:.3g}, {where} has "
            f"{room_area:.3g}: at most {int(room_area / claimed)} can fit; lower count, area_fraction or gap"
        )
    slots, pitch = _slots(M, width) if region is None else _slots_in(M, width, region, gap)
    centers = slots[rng.permutation(len(slots))[:M]]
    angles = rng.uniform(-np.pi, np.pi, size=M)
    room = None if region is None else region.buffer(-gap)
    shapely.prepare(room)
    size = np.full(M, min(1.0, (pitch - gap) / (2 * radius)))
    if size[0] <= 0:
        raise ValueError(f"{M} vesicles with gaps of {gap:g} do not fit into a box of {box[0]:g} x {box[1]:g}: enlarge it or lower gap")

    corners_each = CORNERS if M <= MANY else CORNERS_OF_MANY
    outline = np.stack([np.asarray(p.exterior.coords.xy) for p in polygons(shapes, max(1, corners_each // shapes.shape[2]))])
    cell = 2.0 * radius + gap
    around = np.maximum(1, 2 * np.floor(width / (2.0 * cell)).astype(int))  # cells of a periodic box: an even number, or one
    moved = np.zeros(M, dtype=int)

    def corners(index: np.ndarray, x: np.ndarray, a: np.ndarray, grown: np.ndarray) -> np.ndarray:
        c, s = (grown * np.cos(a))[:, None], (grown * np.sin(a))[:, None]
        px, py = outline[index, 0], outline[index, 1]
        return np.stack([c * px - s * py + x[:, :1], s * px + c * py + x[:, 1:]], axis=-1)

    def cells(x: np.ndarray) -> np.ndarray:
        if periodic:
            return np.floor(np.mod(x + offset, width) * around / width).astype(int) % around
        return np.floor((x + offset) / cell).astype(int)

    outlines = corners(np.arange(M), centers, angles, size)
    now = np.asarray(shapely.polygons(outlines))
    while moved.mean() < MOVES or size.min() < 1.0:
        if moved.mean() > MOST_MOVES:
            other = 'or use placement = "grid"' if region is None else "or give the walls more room"
            raise ValueError(
                f"no random packing of {M} vesicles in {where} was found ({(size < 1).sum()} did not fit after {MOST_MOVES} moves each): "
                f"lower count, area_fraction or gap, {other}"
            )
        offset = rng.uniform(0.0, 2.0 * cell, size=2)
        index = cells(centers)
        active = np.flatnonzero(((index + rng.integers(0, 2, size=2)) % 2 == 0).all(axis=1))
        if len(active) == 0:
            continue
        active = rng.permutation(active)
        _, first = np.unique(index[active], axis=0, return_index=True)
        chosen = active[np.sort(first)]
        moved[chosen] += 1
        step = rng.uniform(0.02, 1.0, size=len(chosen)) ** 2  # small moves are the ones accepted where it is crowded
        x = centers[chosen] + step[:, None] * rng.normal(scale=radius, size=(len(chosen), 2))
        a = angles[chosen] + step * rng.uniform(-LARGEST_TURN, LARGEST_TURN, size=len(chosen))
        grown = np.minimum(1.0, size[chosen] * rng.uniform(1.0, LARGEST_GROWTH, size=len(chosen)))
        x = np.mod(x, width) if periodic else x
        new = corners(chosen, x, a, grown)
        free = (cells(x) == index[chosen]).all(axis=1)
        if not periodic:
            free &= ((new.min(axis=1) >= 0.5 * gap) & (new.max(axis=1) <= width - 0.5 * gap)).all(axis=1)
        candidates = np.asarray(shapely.polygons(new))
        if room is not None:
            free &= shapely.contains_properly(room, candidates)
        image, shift = _images(centers, width, cell) if periodic else (np.arange(M), np.zeros((M, 2)))
        near = cKDTree(x).sparse_distance_matrix(cKDTree(centers[image] + shift), cell, output_type="ndarray")
        near = near[(chosen[near["i"]] != image[near["j"]]) | shift[near["j"]].any(axis=1)]
        i, j, shift = near["i"], image[near["j"]], shift[near["j"]]
        others = now[j]
        k = np.flatnonzero(shift.any(axis=1))
        if len(k):
            own = (chosen[i[k]] == j[k])[:, None, None]  # the image moves and turns as well
            others[k] = shapely.polygons(np.where(own, new[i[k]], outlines[j[k]]) + shift[k][:, None, :])
        close = shapely.dwithin(candidates[i], others, gap)
        free[np.unique(i[close])] = False
        accepted = chosen[free]
        centers[accepted], angles[accepted], size[accepted], now[accepted] = x[free], a[free], grown[free], candidates[free]
        outlines[accepted] = new[free]
    return centers, angles


def _images(centers: np.ndarray, width: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """All images of points in a periodic box that are within reach of it, themselves first: number (Q,) and displacement (Q, 2)."""
    number, shift = [np.arange(len(centers))], [np.zeros_like(centers)]
    columns, rows = np.ceil(reach / width).astype(int)
    for m in range(-columns, columns + 1):
        for n in range(-rows, rows + 1):
            d = np.array([m, n]) * width
            near = np.flatnonzero(((centers + d >= -reach) & (centers + d <= width + reach)).all(axis=1) & bool(m or n))
            number.append(near)
            shift.append(np.broadcast_to(d, (len(near), 2)))
    return np.concatenate(number), np.concatenate(shift)


def _slots(M: int, width: np.ndarray) -> tuple[np.ndarray, float]:
    """Centres (S, 2) of at least M squares that fill a box, and their width."""
    pitch = optimize.brentq(lambda c: np.prod(np.maximum(np.floor(width / c), 0)) - M + 0.5, 1e-9 * width.min(), 2 * width.max())
    pitch *= 1 - 1e-9
    per_row = np.floor(width / pitch).astype(int)
    slot = np.arange(per_row.prod())
    return (np.stack([slot % per_row[0], slot // per_row[0]], axis=1) + 0.5) * width / per_row, pitch


def _slots_in(M: int, width: np.ndarray, region: shapely.Polygon, gap: float) -> tuple[np.ndarray, float]:
    """The same in a part of the box: squares whose inscribed circles lie in the region, the largest that are found."""
    wanted = M
    while True:
        slots, pitch = _slots(wanted, width)
        reach = shapely.distance(shapely.points(slots), region.boundary)
        inside = shapely.contains_xy(region, slots) & (reach > 0.5 * (pitch + gap))
        if inside.sum() >= M:
            return slots[inside], pitch
        wanted = max(wanted + 1, int(1.2 * wanted))
        if pitch <= gap:
            raise ValueError(f"{M} vesicles with gaps of {gap:g} do not fit between the walls: lower count, area_fraction or gap")


def assemble(shapes: np.ndarray, centers: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Shapes (M, 2, N) turned and moved to their places."""
    return np.stack([place(X, c, a) for X, c, a in zip(shapes, centers, angles, strict=True)])
