# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""torch-fem: quasi-static finite elements in PyTorch with implicit derivatives of the solution. It has no motions."""

from importlib.metadata import version
from typing import Any

import torch
from torchfem import Solid
from torchfem.materials import Hyperelastic3D

from dln_jax.softbody.mesh.mesh import lumped_masses
from scripts.reports.soft_bodies.rivals.body import DENSITY, GRAVITY, Body, Run, measured

VERSION = f"torch-fem {version('torch-fem')}, torch {torch.__version__}"
INCREMENTS = (0.0, 0.5, 1.0)


def static(body: Body) -> Run:
    """Equilibrium under the weight, in two increments of the load."""
    modulus = torch.tensor(body.modulus, dtype=torch.float64)
    return measured(body, lambda: (_solve(body, modulus) + torch.tensor(body.mesh.vertices)).numpy()[None])


def static_gradient(body: Body) -> tuple[Run, float]:
    """Derivative of the mean height at equilibrium by Young's modulus, in m/Pa."""

    def slope() -> Any:
        modulus = torch.tensor(body.modulus, dtype=torch.float64, requires_grad=True)
        _solve(body, modulus)[:, 2].mean().backward()
        return modulus.grad

    return measured(body, slope), float(slope())


def _solve(body: Body, modulus: Any) -> Any:
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)

    def density(F: Any, parameters: Any) -> Any:
        mu, lam = parameters[0], parameters[1]
        # The determinant as a polynomial: the second derivative of torch.det is not finite at F = I.
        change = torch.sum(F[0] * torch.linalg.cross(F[1], F[2])) - 1
        return 0.5 * mu * (torch.sum(F**2) - 3) - mu * change + 0.5 * (lam + mu) * change**2

    mu = modulus / (2 * (1 + body.ratio))
    parameters = torch.stack([mu, 2 * mu * body.ratio / (1 - 2 * body.ratio)])
    nodes, elements = torch.tensor(body.mesh.vertices), torch.tensor(body.mesh.elements)
    model = Solid(nodes, elements, Hyperelastic3D(density, parameters))
    model.forces[:, 2] = -GRAVITY * torch.tensor(lumped_masses(body.mesh, DENSITY))
    model.constraints[body.held] = True
    listed = parameters if modulus.requires_grad else None
    return model.solve(torch.tensor(INCREMENTS), differentiable_parameters=listed)[0]
