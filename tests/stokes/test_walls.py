"""Walls against exact flows between cylinders and in a channel; loads; convergence; no flow through them."""

import numpy as np
import torch
from helpers import circle, ellipse, nodes, rotate

from biem.curves import wall_shapes
from biem.curves.fourier import resample
from biem.stokes.interaction import Fields, Interaction
from biem.stokes.single_layer import single_layer
from biem.stokes.walls import Walls

MU, A, B, INNER, OUTER = 1.7, 1.0, 2.5, 0.7, -0.4


def turning(X, omega):
    return omega * np.stack([-X[1], X[0]], axis=1)


def couette(N, inner=INNER, outer=OUTER, shift=(0.0, 0.0)):
    """Cylinders of radius A and B about the origin, that turn; N nodes on the inner one."""
    curves = (circle(2 * N, B), circle(N, A))
    return Walls(curves, np.array([[0.0, 0.0], shift]), MU, np.concatenate([turning(curves[0], outer), turning(curves[1], inner)]))


def exact_couette(x):
    r2 = (x**2).sum(axis=1, keepdims=True)
    rigid, vortex = (OUTER * B**2 - INNER * A**2) / (B**2 - A**2), (INNER - OUTER) * A**2 * B**2 / (B**2 - A**2)
    return (rigid + vortex / r2) * np.stack([-x[:, 1], x[:, 0]], axis=1)


def ring(radius, P=40):
    t = 2 * np.pi * (np.arange(P) + 0.37) / P
    return radius * np.stack([np.cos(t), np.sin(t)], axis=1)


BETWEEN = np.concatenate(
    [ring(r) for r in (A + 1e-8, A + 1e-3, A + 0.1, 1.7, B - 0.1, B - 1e-3, B - 1e-8)] + [np.array([[A + 1e-9, 0.0], [0.0, B - 1e-9]])]
)


def flow_at(walls, x):
    return walls.flow(x.T[None])[0].T


def test_couette_flow_is_exact_everywhere_between_the_cylinders():
    assert np.abs(flow_at(couette(64), BETWEEN) - exact_couette(BETWEEN)).max() < 1e-10


def test_couette_flow_converges_spectrally():
    errors = [np.abs(flow_at(couette(N), BETWEEN) - exact_couette(BETWEEN)).max() for N in (12, 24, 48)]
    assert errors[1] < 1e-2 * errors[0]
    assert errors[2] < 1e-3 * errors[1]


def test_torque_on_the_inner_cylinder():
    walls = couette(48, shift=(0.2, 0.1))
    force, torque = walls.loads(walls.density(walls.driven))
    exact = 4 * np.pi * MU * (INNER - OUTER) * A**2 * B**2 / (B**2 - A**2)
    assert abs(torque[0] / exact - 1) < 1e-11
    assert np.abs(force).max() < 1e-10


def test_force_on_a_cylinder_that_moves_in_another_one():
    walls, U = couette(48), np.array([1.0, -0.5])
    force, torque = walls.loads(walls.density(np.concatenate([np.zeros((96, 2)), np.tile(U, (48, 1))])))
    exact = 4 * np.pi * MU * U / (np.log(B / A) - (B**2 - A**2) / (B**2 + A**2))
    assert np.abs(force[0] / exact - 1).max() < 1e-11
    assert abs(torque[0]) < 1e-10


def test_rigid_rotation_of_everything_loads_nothing():
    walls = couette(32, 0.9, 0.9)
    assert np.abs(flow_at(walls, BETWEEN) - 0.9 * np.stack([-BETWEEN[:, 1], BETWEEN[:, 0]], axis=1)).max() < 1e-10
    force, torque = walls.loads(walls.density(walls.driven))
    assert max(np.abs(force).max(), np.abs(torque).max()) < 1e-9


def test_channel_carries_the_parabola_that_enters_it():
    X = wall_shapes.channel(512, 8.0, 1.0)
    walls = Walls((X,), np.zeros((1, 2)), 1.0, np.stack([1 - X[1] ** 2, 0 * X[1]], axis=1))
    x = np.array([[0.0, 0.0], [1.2, 0.5], [-2.0, -0.9], [0.3, 1 - 1e-4], [3.5, 0.2], [3.99, 0.0]])
    exact = np.stack([1 - x[:, 1] ** 2, 0 * x[:, 1]], axis=1)
    assert np.abs(flow_at(walls, x) - exact).max() < 1e-9


def obstacles(N):
    """A turning cylinder with an ellipse, a triangle and a star in it; the finer, the more nodes."""
    bodies = [
        rotate(wall_shapes.ellipse(N, 0.5, 0.5), 0.4) + np.array([[1.0], [0.3]]),
        wall_shapes.polygon(2 * N, 0.4, 3) + np.array([[-0.9], [0.6]]),
        wall_shapes.star(2 * N, 0.4, 4) + np.array([[-0.2], [-1.0]]),
    ]
    outer = circle(2 * N, 2.0)
    motion = [turning(outer, 1.0), *(np.zeros((X.shape[1], 2)) for X in bodies)]
    return Walls((outer, *bodies), np.array([X.mean(axis=1) for X in (outer, *bodies)]), 1.0, np.concatenate(motion))


def test_obstacles_of_several_shapes_converge_spectrally():
    x = np.array([[0.3, 0.1], [1.6, 0.3], [-0.6, -0.3], [1.2, -1.2], [0.0, 1.9], [1.0 + 0.9, 0.0]])
    exact = flow_at(obstacles(256), x)
    errors = [np.abs(flow_at(obstacles(N), x) - exact).max() for N in (48, 96, 160)]
    assert errors[1] < 0.05 * errors[0]
    assert errors[2] < 0.05 * errors[1]
    assert errors[2] < 1e-7


def vesicles(N):
    """Two ellipses, each about 0.1 from a wall, the outer one and the first obstacle, with forces that do not add up to zero."""
    X = np.stack([0.2 * ellipse(N, 1.0, 0.5) + np.array([[0.0], [1.8]]), 0.2 * ellipse(N, 0.4, 1.0) + np.array([[0.15], [0.1]])])
    t = nodes(N)
    f = np.stack([np.cos(t) + 0.3, np.sin(2 * t) - 0.4])
    return X, np.stack([f, f[::-1] - 0.2])


def test_nothing_flows_through_the_walls_beside_vesicles():
    X, f = vesicles(96)
    through = []
    for N in (64, 192):
        walls = obstacles(N)
        points = []
        for wall, center, side in zip(walls.curves, walls.centers, (-1, 1, 1, 1), strict=True):
            fine = resample(wall, 3 * wall.shape[1])
            points.append((fine + 1e-10 * side * (fine - center[:, None]))[:, 1::3].T)  # between the nodes, on the fluid's side
        x = np.concatenate(points)
        at_nodes = single_layer(X, f, walls.nodes, tolerance=1e-12)
        u = single_layer(X, f, x, tolerance=1e-12) + walls.answer(x, at_nodes)
        through.append(np.abs(u).max() / np.abs(at_nodes).max())
    assert through[0] > 1e-6
    assert through[1] < 1e-8


def test_interaction_is_the_answer_to_all_vesicles_and_the_velocity_by_the_others():
    walls = obstacles(64)
    X, f = vesicles(64)
    fields = Fields(near_tolerance=1e-10, far_tolerance=1e-12)
    u = Interaction.build(X, 1.0, fields, walls=walls).velocity(f)
    answer = lambda x: walls.answer(x, single_layer(X, f, walls.nodes, tolerance=1e-10))
    for m in (0, 1):
        by_other = single_layer(X[[1 - m]], f[[1 - m]], X[m].T, tolerance=1e-10)
        assert np.abs(u[m].T - by_other - answer(X[m].T)).max() < 1e-9
    part = Interaction.build(X, 1.0, fields, slice(1, 2), stored=True, walls=walls).velocity(f)
    assert np.abs(part - u[1:]).max() < 1e-9


def test_one_vesicle_feels_its_own_image():
    walls = obstacles(96)
    X, f = vesicles(64)
    u = Interaction.build(X[:1], 1.0, Fields(), walls=walls).velocity(f[:1])
    assert np.abs(u).max() > 1e-3


def test_distance_to_the_closest_wall():
    walls = couette(32)
    x = np.array([[1.2, 0.0], [0.0, 2.4], [-2.6, 0.0], [0.0, -0.9]])
    assert np.abs(walls.distance(x) - [0.2, 0.1, -0.1, -0.1]).max() < 1e-12


def test_numpy_and_torch_agree():
    walls = obstacles(64)
    x = np.array([[0.3, 0.1], [1.99, 0.0], [-0.6, -0.3]])
    g = np.sin(np.arange(2.0 * len(walls.nodes))).reshape(-1, 2)
    ours, theirs = walls.answer(x, g), walls.answer(torch.as_tensor(x), torch.as_tensor(g))
    assert np.abs(ours - theirs.numpy()).max() < 1e-13


def test_a_net_flux_through_the_outer_wall_is_left_out():
    """The normal on the outer wall spans what no flow can do: without the rank-one term the equations are singular there."""
    walls = couette(48)
    flux = np.zeros_like(walls.nodes)
    flux[walls.slices[0]] = walls.parts[0].normal.T
    tau = walls.density(flux)
    assert np.abs(tau).max() < 10.0
    assert np.abs(walls.velocity(BETWEEN, tau)).max() < 1e-9
    assert np.abs(walls.velocity(BETWEEN, walls.density(walls.driven + 0.3 * flux)) - exact_couette(BETWEEN)).max() < 1e-9
