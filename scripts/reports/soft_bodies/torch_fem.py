# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""torch-fem: quasi-static finite elements in PyTorch with implicit derivatives of the solution. It has no motions."""

from typing import Any

import torch
from torchfem import Solid
from torchfem.materials import Hyperelastic3D

from dln_jax.softbody.mesh import lumped_masses
from scripts.reports.soft_bodies.body import DENSITY, GRAVITY, Body, Run, measured


def static(body: Body) -> tuple[Run, Run]:
    """Equilibrium under the weight, and the derivative of its mean height by Young's modulus, m/Pa."""

    def positions() -> Any:
        modulus = torch.tensor(body.modulus, dtype=torch.float64)
        return (solved(body, modulus) + torch.tensor(body.mesh.vertices)).numpy()[None]

    def slope() -> Any:
        modulus = torch.tensor(body.modulus, dtype=torch.float64, requires_grad=True)
        solved(body, modulus)[:, 2].mean().backward()
        return modulus.grad

    return measured(body, positions), measured(body, slope)


def solved(body: Body, modulus: Any) -> Any:
    """Displacements, in two increments of the load."""
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)

    def density(F: Any, parameters: Any) -> Any:
        mu, lam = parameters[0], parameters[1]
        # The determinant as a polynomial: the second derivative of torch.det is not finite at F = I.
        change = torch.sum(F[0] * torch.linalg.cross(F[1], F[2])) - 1
        return 0.5 * mu * (torch.sum(F**2) - 3) - mu * change + 0.5 * (lam + mu) * change**2

    parameters = torch.stack([modulus / 2.6, 0.3 * modulus / (1.3 * 0.4)])
    nodes, elements = torch.tensor(body.mesh.vertices), torch.tensor(body.mesh.elements)
    model = Solid(nodes, elements, Hyperelastic3D(density, parameters))
    model.forces[:, 2] = -GRAVITY * torch.tensor(lumped_masses(body.mesh, DENSITY))
    model.constraints[body.held] = True
    listed = parameters if modulus.requires_grad else None
    return model.solve(torch.tensor((0.0, 0.5, 1.0)), differentiable_parameters=listed)[0]
