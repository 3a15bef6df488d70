"""Fields of suspensions: jumps at the membranes, the Stokes equations by finite differences, exact flows, walls, contrasts, images."""

import numpy as np
import pytest
from scene_helpers import scene_of, write_flow

from biem.curves.curve import length, normal
from biem.observe.fields import CHUNK_VALUES, FLUID, QUANTITIES, WALL, FlowField, field_bytes
from biem.observe.instant import Instant, instant
from biem.scene.build import build

PAIR = {"vesicles": {"centers": [[-0.16, 0.05], [0.16, 0.0]], "angles": [1.4, 1.6], "points": 64, "reduced_area": 0.7}}
RING = {
    "walls": {"kind": "couette", "radius": 1.0, "inner_radius": 0.4, "omega": 20.0, "inner_omega": -30.0},
    "flow": {"kind": None, "rate": None},
}
IN_RING = {"vesicles": {"centers": [[0.7, 0.0]], "angles": [1.2], "points": 64}}
CASES = {
    "open": (PAIR, {"physics": {"mu": 1.7}}),
    "contrast": (PAIR, {"vesicles": {"contrast": [4.0, 0.3]}, "physics": {"mu": 1.7}}),
    "walls": (RING, IN_RING),
    "walls and contrast": (RING, IN_RING, {"vesicles": {"contrast": 3.0}}),
    "periodic": (PAIR, {"domain": {"periodic": [0.9, 0.8]}}),
    "taylor_green": (PAIR, {"flow": {"kind": "taylor_green", "rate": 60.0, "width": 0.7}}),
}


def field_of(name, tolerance=1e-8, **more):
    problem = build(scene_of(*CASES[name]))
    return FlowField(problem, instant(problem, problem.X), tolerance, **more)


@pytest.fixture(scope="module")
def fields():
    return {name: field_of(name) for name in CASES}


def nodes_of(flow):
    """Nodes, outward normals and force densities (M N, 2), and the length of a membrane."""
    flat = lambda a: a.transpose(0, 2, 1).reshape(-1, 2)
    X = flow.at.X
    return flat(X), flat(normal(X)), flat(flow.at.force), float(length(X).mean())


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("distance", [1e-8, 1e-10])
def test_at_the_membranes_stress_jumps_by_the_force_and_velocity_does_not(fields, name, distance):
    flow = fields[name]
    x, n, f, L = nodes_of(flow)
    outer, inner = (flow.values(x + side * distance * L * n, QUANTITIES) for side in (1.0, -1.0))
    assert (outer.inside == FLUID).all()
    assert np.array_equal(inner.inside, np.repeat(np.arange(len(flow.at.X)), flow.at.X.shape[-1]))
    speed = np.abs(outer.velocity).max()
    assert np.abs(outer.velocity - inner.velocity).max() < 1e-6 * speed
    traction = np.einsum("pij,pj->pi", outer.stress - inner.stress, n)
    assert np.abs(traction + f).max() < 1e-6 * np.abs(f).max()
    # the membrane does not stretch: the pressure alone takes the normal force
    assert (
        np.abs(outer.pressure - inner.pressure - (f * n).sum(-1)).max()
        < (1e-6 if flow.problem.contrast is None else 1e-4) * np.abs(f).max()
    )


@pytest.mark.parametrize("name", CASES)
def test_on_the_membranes_velocity_is_the_instants_and_stress_the_outer_one(fields, name):
    flow = fields[name]
    x, n, _, L = nodes_of(flow)
    on, outer = flow.values(x, QUANTITIES), flow.values(x + 1e-9 * L * n, QUANTITIES)
    u = flow.at.velocity.transpose(0, 2, 1).reshape(-1, 2)
    assert (on.inside == FLUID).all()
    assert np.abs(on.velocity - u).max() < 1e-6 * np.abs(u).max()
    assert np.abs(on.stress - outer.stress).max() < 1e-6 * np.abs(on.stress).max()


def away(flow, P=60):
    """Points about the membranes, inside and outside, in the fluid and not too close to a membrane."""
    x, _, _, L = nodes_of(flow)
    drawn = np.random.default_rng(0).uniform(x.min(0) - 0.1, x.max(0) + 0.1, (4 * P, 2))
    gap = np.hypot(*(drawn[:, None] - x).transpose(2, 0, 1)).min(-1)
    return drawn[(gap > 0.02 * L) & (flow.inside(drawn) != WALL)][:P]


@pytest.mark.parametrize("name", CASES)
def test_fields_solve_the_stokes_equations(fields, name):
    flow, h = field_of(name, 1e-11), 2e-4
    x = away(flow)
    here = flow.values(x, QUANTITIES)
    assert len(set(here.inside)) == len(flow.at.X) + 1
    moved = [flow.values(x + h * np.array(step), QUANTITIES) for step in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    slope = lambda of: np.stack([(of(moved[0]) - of(moved[1])), (of(moved[2]) - of(moved[3]))], axis=-1) / (2 * h)
    du = slope(lambda v: v.velocity)  # [p, i, k] = du_i/dx_k
    mu = flow.problem.scene.physics.mu
    thickness = np.ones(len(x)) if flow.problem.contrast is None else np.append(flow.problem.contrast, 1.0)[here.inside]
    size = np.abs(du).max()
    assert np.abs(du[:, 0, 0] + du[:, 1, 1]).max() < 1e-4 * size
    assert np.abs(here.vorticity - (du[:, 1, 0] - du[:, 0, 1])).max() < 1e-4 * size
    newton = -here.pressure[:, None, None] * np.eye(2) + (mu * thickness)[:, None, None] * (du + du.transpose(0, 2, 1))
    assert np.abs(here.stress - newton).max() < 1e-4 * np.abs(newton).max()
    assert np.array_equal(here.stress, here.stress.transpose(0, 2, 1))
    force = slope(lambda v: v.stress)
    divergence = force[:, :, 0, 0] + force[:, :, 1, 1]
    if flow.problem.flow.kind == "taylor_green":  # it is held up by a body force
        width = flow.problem.flow.width
        divergence += 2 * mu * (np.pi / width) ** 2 * flow.problem.flow.velocity(x.T[None], 0.0)[0].T
    assert np.abs(divergence).max() < 2e-3 * np.abs(force).max()


KINDS = {
    "shear": {"rate": 1.3},
    "extensional": {"rate": 1.3},
    "poiseuille": {"rate": 1.3, "width": 0.8},
    "taylor_green": {"rate": 1.3, "width": 0.8},
    "rotation": {"rate": 1.3, "width": 0.8},
    "quiescent": {"rate": None},
}


@pytest.mark.parametrize("kind", KINDS)
def test_background_flows_have_their_pressures_and_stresses(kind):
    problem = build(scene_of(vesicles={"centers": [[5.0, 0.0]]}, flow={"kind": kind, **KINDS[kind]}, time={"dt": 1.0, "horizon": 1.0}))
    nothing = Instant(0.0, problem.X, 0 * problem.X[:, 0], 0 * problem.X, 0 * problem.X)
    flow, h = FlowField(problem, nothing), 1e-4
    x = np.random.default_rng(1).uniform(0.5, 1.5, (30, 2))
    here = flow.values(x, QUANTITIES)
    moved = [flow.values(x + h * np.array(step), QUANTITIES) for step in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    du = np.stack([moved[0].velocity - moved[1].velocity, moved[2].velocity - moved[3].velocity], axis=-1) / (2 * h)
    assert np.abs(here.velocity - problem.flow.velocity(x.T[None], 0.0)[0].T).max() == 0
    assert np.abs(here.vorticity - (du[:, 1, 0] - du[:, 0, 1])).max() < 1e-6
    assert np.abs(here.stress + here.pressure[:, None, None] * np.eye(2) - du - du.transpose(0, 2, 1)).max() < 1e-6
    if kind == "poiseuille":
        assert np.abs(here.pressure + 2 * 1.3 / 0.8 * x[:, 0]).max() < 1e-12
    else:
        assert np.abs(here.pressure).max() == 0
    without = FlowField(problem, nothing, disturbance=True).values(x, QUANTITIES)
    assert max(np.abs(getattr(without, name)).max() for name in QUANTITIES) == 0


def test_the_centre_of_rotation_is_not_a_number_and_nothing_else():
    problem = build(scene_of(vesicles={"centers": [[5.0, 0.0]]}, flow={"kind": "rotation", "rate": 1.0, "width": 1.0}))
    flow = FlowField(problem, instant(problem, problem.X))
    found = flow.values(np.array([[0.0, 0.0], [1e-3, 0.0]]), QUANTITIES)
    for name in QUANTITIES:
        assert np.isnan(getattr(found, name)[0]).all()
        assert np.isfinite(getattr(found, name)[1]).all()


def test_a_custom_flow_has_a_velocity_and_a_disturbance(tmp_path):
    module = write_flow(tmp_path, "def shear(x, y, t):\n    return 100.0 * y, 0.0 * x\n")
    custom = build(scene_of(flow={"kind": "custom", "rate": None, "function": f"{module}.shear"}, folder=tmp_path))
    named = build(scene_of(flow={"kind": "shear"}))
    x = np.array([[0.0, 0.0], [0.3, 0.2], [-0.1, 0.5]])
    flows = [FlowField(problem, instant(problem, problem.X)) for problem in (custom, named)]
    assert np.abs(flows[0].values(x).velocity - flows[1].values(x).velocity).max() < 1e-9
    with pytest.raises(ValueError, match="only the velocity of this flow is known"):
        flows[0].values(x, ("pressure",))
    disturbances = [FlowField(flow.problem, flow.at, disturbance=True).values(x, QUANTITIES) for flow in flows]
    for name in QUANTITIES:
        assert np.abs(getattr(disturbances[0], name) - getattr(disturbances[1], name)).max() < 1e-6


def ring_at(radius, P=40):
    t = 2 * np.pi * (np.arange(P) + 0.3) / P
    return radius * np.stack([np.cos(t), np.sin(t)], axis=1)


def test_between_turning_cylinders_pressure_is_even_and_stress_exact():
    """Without vesicles' forces: u = (A + B/r^2) omega-wise, shear stress -2 mu B/r^2, pressure constant."""
    problem = build(scene_of(RING, IN_RING))
    nothing = Instant(0.0, problem.X, 0 * problem.X[:, 0], 0 * problem.X, 0 * problem.X)
    flow = FlowField(problem, nothing, 1e-10)
    a, b, inner, outer = 0.4, 1.0, -30.0, 20.0
    B = (inner - outer) * a**2 * b**2 / (b**2 - a**2)
    for radius in (a + 1e-8, a + 1e-3, 0.6, 0.9, b - 1e-3, b - 1e-8):
        x = ring_at(radius)
        found = flow.values(x, QUANTITIES)
        e_r, e_t = x / radius, np.stack([-x[:, 1], x[:, 0]], axis=1) / radius
        components = [np.einsum("pi,pij,pj->p", e, found.stress, f) for e, f in ((e_r, e_t), (e_r, e_r), (e_t, e_t))]
        assert np.abs(components[0] + 2 * B / radius**2).max() < 1e-6 * 2 * abs(B) / a**2
        assert np.abs(components[1] + found.pressure).max() < 1e-6 * 2 * abs(B) / a**2
        assert np.abs(components[1] - components[2]).max() < 1e-6 * 2 * abs(B) / a**2
        assert np.abs(found.pressure - flow.values(ring_at(0.7), ("pressure",)).pressure.mean()).max() < 1e-6 * 2 * abs(B) / a**2
        assert np.abs(found.vorticity - 2 * (outer * b**2 - inner * a**2) / (b**2 - a**2)).max() < 1e-5 * abs(B) / a**2


def test_walls_hold_the_fluid_and_what_is_beyond_is_not_a_number(fields):
    flow = fields["walls"]
    on_wall = np.concatenate([ring_at(1.0 - 1e-9), ring_at(0.4 + 1e-9)])
    u = flow.values(on_wall).velocity
    turning = np.concatenate([20.0 * np.ones(40), -30.0 * np.ones(40)])[:, None] * np.stack([-on_wall[:, 1], on_wall[:, 0]], axis=1)
    assert np.abs(u - turning).max() < 1e-5 * 20
    still = field_of("walls", disturbance=True).values(on_wall).velocity
    assert np.abs(still).max() < 1e-5 * 20
    found = flow.values(np.array([[0.0, 0.0], [1.2, 0.0], [0.7, 0.0], [-0.7, 0.0]]), QUANTITIES)
    assert found.inside.tolist() == [WALL, WALL, 0, FLUID]
    for name in QUANTITIES:
        values = getattr(found, name)
        assert np.isnan(values[:2]).all()
        assert np.isfinite(values[2:]).all()


def test_membranes_exert_no_force_on_the_fluid_around_all_of_them(fields):
    """The stress integrated over a circle."""
    flow = fields["open"]
    x = 0.8 * np.stack(
        [np.cos(np.linspace(0, 2 * np.pi, 200, endpoint=False)), np.sin(np.linspace(0, 2 * np.pi, 200, endpoint=False))], axis=1
    )
    stress = flow.values(x, ("stress",)).stress
    total = np.einsum("pij,pj->pi", stress, x / 0.8).sum(0) * 2 * np.pi * 0.8 / 200
    assert np.abs(total).max() < 1e-6 * np.abs(stress).max()


def test_periodic_pressure_has_no_mean_over_the_box(fields):
    flow = fields["periodic"]
    side = (np.arange(60) + 0.5) / 60 - 0.5
    x = np.stack(np.meshgrid(0.9 * side, 0.8 * side), axis=-1).reshape(-1, 2)
    found = flow.values(x, ("pressure", "vorticity"))
    assert abs(found.pressure.mean()) < 0.01 * np.abs(found.pressure).max()
    assert abs(found.vorticity.mean() + 100.0) < 0.01 * np.abs(found.vorticity).max()  # that of the shear


def test_points_in_chunks_are_the_same_numbers(fields, monkeypatch):
    flow, x = fields["walls"], np.random.default_rng(3).uniform(-1.1, 1.1, (100, 2))
    whole = flow.values(x, QUANTITIES)
    monkeypatch.setattr("biem.observe.fields.CHUNK", 17)
    parts = flow.values(x, QUANTITIES)
    for name in ("inside", *QUANTITIES):
        assert np.array_equal(getattr(whole, name), getattr(parts, name), equal_nan=True)
    assert flow.values(np.zeros((0, 2)), QUANTITIES).stress.shape == (0, 2, 2)


@pytest.mark.parametrize("points", [np.zeros(2), np.zeros((3, 3)), np.array([[np.nan, 0.0]])])
def test_points_that_are_none_are_refused(fields, points):
    with pytest.raises(ValueError, match="expected finite numbers"):
        fields["open"].values(points)


def test_an_unknown_quantity_is_refused(fields):
    with pytest.raises(ValueError, match='quantity "speed": expected velocity, pressure'):
        fields["open"].values(np.zeros((1, 2)), ("speed",))


def test_memory_grows_with_points_and_quantities(fields):
    problem = fields["open"].problem
    few, many = (field_bytes(problem, P, ("velocity",)) for P in (1e6, 1e8))
    assert many - few == pytest.approx(8 * 2 * 5 * (1e8 - 1e6), rel=1e-6)
    assert field_bytes(problem, 1e8, QUANTITIES) > 1.5 * many
    assert few > 8 * CHUNK_VALUES * 2**18


def test_fields_of_a_sheared_box_are_those_of_its_time():
    """On the membranes they have the instant's velocity, whose images are where they are then; one row up the flow is faster."""
    pair = {"vesicles": {"centers": [[0.0, 0.3], [0.1, -0.3]], "angles": [0.0, 0.0], "points": 32}, "domain": {"periodic": [1.0, 0.9]}}
    problem = build(scene_of(pair))
    at = instant(problem, problem.X, 0.004)
    field, nodes_of = FlowField(problem, at, 1e-8), problem.X[0].T
    assert np.abs(field.values(nodes_of).velocity - at.velocity[0].T).max() < 1e-5 * np.abs(at.velocity).max()
    above = field.values(nodes_of + problem.box.at(0.004).vectors[1]).velocity - field.values(nodes_of).velocity
    assert np.abs(above - [90.0, 0.0]).max() < 1e-6
