"""Bodies at rest under load, against closed forms.

Uniaxial stress of a neo-Hookean block, the patch test, the elastica, and a cantilever under its own weight. Linear
elements are too stiff in bending, by an error of order h²: what counts is the order and the value extrapolated from
two meshes (Richardson), u = u_h + (u_h - u_2h)/3.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import eigsh, spsolve

from dln_jax.softbody.equilibrium import static_solve
from dln_jax.softbody.mesh.mesh import boundary_vertices, make_mesh, vertices_where
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.scene import Params, SoftScene, element_energies, make_scene, prepare, with_parameters
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.strain_energies import neo_hookean, st_venant_kirchhoff, stable_neo_hookean
from dln_jax.solvers.elements.assembly import entries, gradient, pattern
from dln_jax.solvers.elements.energies import element_hessians
from dln_jax.solvers.elements.minimise import minimise
from scripts.reports.case import Findings
from scripts.reports.rows import expect, largest
from scripts.reports.soft_bodies.common import GRAVITY, cantilever_of, dead_load

UNIAXIAL = {2.0: (0.79807754, 646.74466), 0.5: (1.21076739, -935.35206), 10.0: (0.41653193, 3839.4808)}
"""Stretch -> lateral stretch and nominal stress in Pa, for E = 1e3 Pa and nu = 0.3."""
ELASTICA = {1.0: (0.30172, 0.05643), 2.0: (0.49346, 0.16064), 5.0: (0.71379, 0.38763), 10.0: (0.81061, 0.55500)}
"""P L²/EI -> deflection and shortening of the tip over L."""
SLENDERNESS = 50
"""Length over height of the elastica: shear adds 0.6 (H/L)² to the deflection."""
MODULUS, POISSON, DENSITY = 1e9, 0.3, 1e3
"""Young's modulus, Pa, Poisson's ratio, and density, kg/m³, of the cantilever."""
BENDING, SHEAR = 3.7632e-3, 0.2446e-3
"""Deflection of the cantilever's tip by bending and by shear, m."""
BENDING_FREQUENCY, AXIAL_FREQUENCY = 10.096, 62.5
"""First bending and first axial frequency of the cantilever, Hz."""
SHEAR_FREQUENCY = (5 / 6 * MODULUS / 2.6 / DENSITY) ** 0.5 / 16
"""First frequency of a beam of this length that only shears, in Hz."""


def uniaxial(quick: bool) -> Findings:
    """A block pulled along x whose sides are free: lateral stretch and stress."""
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1) if quick else (2, 2, 2))
    scene = make_scene(mesh, [elastic(mesh, neo_hookean, youngs_modulus=1e3, poisson_ratio=0.3)])
    rest, energies = mesh.vertices, element_energies(scene)
    free = np.stack([(rest[:, 0] > 0) & (rest[:, 0] < 1), rest[:, 1] > 0, rest[:, 2] > 0], axis=1)
    everywhere = pattern(energies, *rest.shape)

    @jax.jit
    def stretched(stretch: Array):
        x = scene.params.rest * jnp.stack([stretch, jnp.ones(()), jnp.ones(())])
        data = prepare(scene, scene.params, x)
        x, info = minimise(energies, x, data, free=free, scale=scene.params.masses, tolerance=1e-9)
        forces = gradient(energies, everywhere, x, data)
        return x, jnp.where(rest[:, 0] == 1, forces[:, 0], 0).sum(), info.converged

    rows = []
    for stretch, (lateral, stress) in UNIAXIAL.items():
        x, force, converged = stretched(jnp.asarray(stretch))
        name = f"uniaxial/stretch-{stretch:g}"
        wide = largest(abs(np.asarray(x)[:, 1:] - lateral * rest[:, 1:])) / lateral
        text = "to the published digits, at every vertex"
        rows += [
            expect(name, "not_converged", "the solver says so", not converged, 0.0),
            expect(name, "lateral_stretch_error", text, wide, 2e-8, reference=lateral),
            expect(name, "nominal_stress_error", text, abs(force / stress - 1), 2e-8, reference=stress),
        ]
    return Findings(rows)


def patch_test(quick: bool) -> Findings:
    """Irregular meshes whose boundary is moved affinely: the inside follows, to rounding."""
    random = np.random.default_rng(0)
    rows = []
    space, plane = box((1.0, 1.0, 1.0), (2, 2, 2)), beam(1.0, 1.0, 4, 4)
    for mesh in (space,) if quick else (plane, space):
        outside = boundary_vertices(mesh)
        inside = np.setdiff1d(np.arange(len(mesh.vertices)), outside)
        vertices = mesh.vertices.copy()
        vertices[inside] += random.uniform(-0.04, 0.04, vertices[inside].shape)
        mesh = make_mesh(vertices, mesh.elements)
        scene = make_scene(mesh, [elastic(mesh, stable_neo_hookean)], held=outside)
        d = mesh.dimension
        F = np.eye(d) + random.uniform(-0.2, 0.2, (d, d))
        affine = vertices @ F.T
        start = affine.copy()
        start[inside] += random.uniform(-0.03, 0.03, start[inside].shape)
        x, info = jax.jit(lambda x, scene=scene: static_solve(scene, scene.params, x=x, tolerance=1e-9))(start)
        name, error = f"patch-test/{d}-d", largest(abs(np.asarray(x) - affine))
        rows.append(expect(name, "not_converged", "the solver says so", not info.converged, 0.0))
        rows.append(expect(name, "largest_position_error", "x = F X inside, to rounding", error, 1e-12, "m"))
    return Findings(rows)


def elastica(quick: bool) -> Findings:
    """A slender cantilever bent far by a load on its tip, under refinement."""
    loads = [1.0, 10.0] if quick else list(ELASTICA)
    meshes = [(200, 4), (400, 8)] if quick else [(200, 4), (400, 8), (800, 16)]
    solutions = np.stack([_bent(cells, loads) for cells in meshes])
    tips, converged = solutions[..., :2], solutions[..., 2].all()
    extrapolated = tips[-1] + (tips[-1] - tips[-2]) / 3
    rows = [expect("elastica", "not_converged", "every equilibrium is found", float(not converged), 0.0)]
    for index, load in enumerate(loads):
        name = f"elastica/load-{load:g}"
        for axis, quantity in enumerate(("deflection", "shortening")):
            expected = ELASTICA[load][axis]
            error = abs(extrapolated[index, axis] / expected - 1)
            text = f"{expected} L, extrapolated from {len(meshes)} meshes; beams of {SLENDERNESS} : 1 shear a little"
            bound = 0.02 if quick else 2e-3
            rows.append(expect(name, f"{quantity}_error", text, error, bound, reference=expected))
        if not quick:
            order = float(np.log2((tips[1, index, 0] - tips[0, index, 0]) / (tips[2, index, 0] - tips[1, index, 0])))
            text = "deflections converge with order 2"
            rows.append(expect(name, "order_error", text, abs(order - 2), 0.25, reference=2.0))
    return Findings(rows)


def _bent(cells: tuple[int, int], loads: list[float]) -> np.ndarray:
    """Deflection and shortening of the tip over the length, and whether the solve converged, for growing loads."""
    height = 1 / SLENDERNESS
    mesh = beam(1.0, height, *cells)
    material = elastic(mesh, st_venant_kirchhoff, youngs_modulus=12 / height**3, poisson_ratio=0.0)
    held = vertices_where(mesh, lambda x: x[:, 0] == 0)
    tip = vertices_where(mesh, lambda x: x[:, 0] == 1)
    scene = make_scene(mesh, [material, dead_load(mesh)], held=held)
    shares = np.zeros(mesh.vertices.shape)
    shares[tip, 1] = -1 / len(tip)
    middle = tip[len(tip) // 2] if len(tip) % 2 else tip

    @jax.jit
    def solve(x: Array, load: Array):
        params = with_parameters(scene.params, load={"forces": load * shares})
        x, info = static_solve(scene, params, x=x, iterations=500)
        return x, info.converged

    x, tips = scene.params.rest, []
    for load in loads:
        x, converged = solve(x, jnp.asarray(load))
        at = np.asarray(x)[middle].reshape(-1, 2).mean(axis=0)
        tips.append([height / 2 - at[1], 1 - at[0], float(converged)])
    return np.array(tips)


def cantilever(quick: bool) -> Findings:
    """A cantilever of 4 m x 1 m x 1 m: deflection under its weight, first bending and first axial frequency.

    In the plane, with the Lamé parameters of plane stress, as a beam's sides are free. The clamped end, which may not
    contract, makes it about a percent stiffer than beam theory; the axial frequency comes so close at once that its
    order is that of the singular corners.
    """
    cells = [(32, 8), (64, 16)] if quick else [(32, 8), (64, 16), (128, 32)]
    numbers = np.array([_clamped(scene) for scene in map(_cantilever, cells)])
    extrapolated = numbers[-1] + (numbers[-1] - numbers[-2]) / 3
    lowered = BENDING_FREQUENCY * (1 + (BENDING_FREQUENCY / SHEAR_FREQUENCY) ** 2) ** -0.5
    expected = {
        "deflection": (BENDING + SHEAR, 0.02, "m", "bending 3.7632 mm and shear 0.2446 mm"),
        "bending_frequency": (lowered, 0.02, "Hz", "Euler-Bernoulli's 10.096 Hz, lowered by shear (Southwell)"),
        "axial_frequency": (AXIAL_FREQUENCY, 0.01, "Hz", "sqrt(E/rho)/4L"),
    }
    rows = []
    for index, (quantity, (value, bound, unit, text)) in enumerate(expected.items()):
        error = float(abs(extrapolated[index] / value - 1))
        text += f"; extrapolated from {len(cells)} meshes: {extrapolated[index]:.5g} {unit}"
        rows.append(expect("cantilever", f"{quantity}_error", text, error, bound, reference=value))
        if not quick and quantity != "axial_frequency":
            order = float(np.log2((numbers[1, index] - numbers[0, index]) / (numbers[2, index] - numbers[1, index])))
            text = "linear elements lock: convergence is of order 2, a little less at the clamped corners"
            rows.append(expect("cantilever", f"{quantity}_order", text, order, 1.5, at_least=True, reference=2.0))
    text = f"{BENDING_FREQUENCY} Hz is the limit of a slender beam, which bounds it from above"
    rows.append(expect("cantilever", "bending_frequency", text, extrapolated[1], BENDING_FREQUENCY, "Hz"))
    scene = _cantilever(cells[0])
    x, info = jax.jit(lambda params: static_solve(scene, params))(scene.params)
    sag = float(-(x[_tip(scene), 1] - scene.params.rest[_tip(scene), 1]).mean())
    text = "the nonlinear equilibrium is the linear one, to second order in deflection / length"
    rows.append(expect("cantilever", "not_converged", "the solver says so", float(not info.converged), 0.0))
    rows.append(expect("cantilever", "nonlinear_to_linear", text, abs(sag / numbers[0, 0] - 1), 1e-4))
    return Findings(rows)


def _cantilever(cells: tuple[int, int]) -> SoftScene:
    modulus, ratio = MODULUS * (1 + 2 * POISSON) / (1 + POISSON) ** 2, POISSON / (1 + POISSON)
    return cantilever_of(beam(4.0, 1.0, *cells), modulus, poisson_ratio=ratio, density=DENSITY)


def _tip(scene: SoftScene) -> np.ndarray:
    return vertices_where(scene.mesh, lambda x: x[:, 0] == 4.0)


def _clamped(scene: SoftScene) -> tuple[float, float, float]:
    """Deflection of the tip in m, first bending and first axial frequency in Hz, of the linearised cantilever."""
    stiffness, free = stiffness_matrix(scene), scene.free.ravel()
    masses = np.repeat(np.asarray(scene.params.masses), 2)
    inner = stiffness[free][:, free]
    u = np.zeros(free.size)
    u[free] = np.asarray(spsolve(inner, (masses * np.tile([0.0, -GRAVITY], free.size // 2))[free]))
    squared, modes = eigsh(inner, k=6, M=diags_array(masses[free]).tocsc(), sigma=0.0)
    along = np.zeros((free.size, 6))
    along[free] = modes * np.sqrt(masses[free])[:, None]
    # The axial mode is the first one that moves along x for the most part.
    shares = (along[0::2] ** 2).sum(axis=0) / (along**2).sum(axis=0)
    frequencies = np.sqrt(squared) / (2 * np.pi)
    sag = -u.reshape(-1, 2)[_tip(scene), 1].mean()
    return float(sag), float(frequencies[0]), float(frequencies[np.argmax(shares > 0.8)])


def stiffness_matrix(scene: SoftScene) -> csc_array:
    """Hessian of the potential in the rest shape."""
    energies, shape = element_energies(scene), scene.mesh.vertices.shape
    at = pattern(energies, *shape)

    @jax.jit
    def values(params: Params):
        return entries(at, element_hessians(energies, params.rest, prepare(scene, params, params.rest)))

    size = at.unknowns
    lower = coo_array((np.asarray(values(scene.params)), (at.rows, at.columns)), shape=(size, size)).tocsc()
    return lower + lower.T - diags_array(lower.diagonal()).tocsc()
