"""C text of the equations of motion of natural systems: `mechanics.natural` and `mechanics.natural_hamiltonian`.

`c_structured` fills in the networks: `${features}` evaluates them along the motion, `${pull_back}` gives -dT/dq + dV/dq
(or +dT/dq where M⁻¹ is given) as `force`, `${values}` and `${factor_values}` evaluate L with and without the potential.
"""

FACTOR = """
/* Triangular factor L (row-major) from the outputs of the network: the diagonal, then what is below it by rows. */
static void unpack_factor(const real *restrict entries, real *restrict L)
{
    int n = D;
    for (int i = 0; i < D; ++i) {
        L[i * D + i] = softplus(entries[i] + DIAGONAL_SHIFT) + DIAGONAL_FLOOR;
        for (int j = 0; j < i; ++j) L[i * D + j] = entries[n++];
        for (int j = i + 1; j < D; ++j) L[i * D + j] = 0;
    }
}

/* L, its rate from the rate of the outputs, and the slope of its diagonal with respect to them. */
static void unpack_factor_rate(const real *restrict entries, const real *restrict entries_rate,
                               real *restrict L, real *restrict L_rate, real *restrict diagonal_slope)
{
    int n = D;
    unpack_factor(entries, L);
    for (int i = 0; i < D; ++i) {
        diagonal_slope[i] = logistic(entries[i] + DIAGONAL_SHIFT);
        L_rate[i * D + i] = diagonal_slope[i] * entries_rate[i];
        for (int j = 0; j < i; ++j) L_rate[i * D + j] = entries_rate[n++];
        for (int j = i + 1; j < D; ++j) L_rate[i * D + j] = 0;
    }
}

/* Covector of the outputs: minus u_i v_j for each element of L. */
static void pack_covector(const real *restrict diagonal_slope, const real *restrict u, const real *restrict v,
                          real *restrict adjoint)
{
    int n = D;
    for (int i = 0; i < D; ++i) {
        adjoint[i] = -diagonal_slope[i] * u[i] * v[i];
        for (int j = 0; j < i; ++j) adjoint[n++] = -u[i] * v[j];
    }
}

/* y = L x and y = L^T x, L lower triangular and row-major */
static void times(const real *restrict L, const real *restrict x, real *restrict y)
{
    for (int i = 0; i < D; ++i) {
        y[i] = 0;
        for (int j = 0; j <= i; ++j) y[i] += L[i * D + j] * x[j];
    }
}

static void times_transposed(const real *restrict L, const real *restrict x, real *restrict y)
{
    for (int j = 0; j < D; ++j) {
        y[j] = 0;
        for (int i = j; i < D; ++i) y[j] += L[i * D + j] * x[i];
    }
}
"""
DELAN = """
/* L, and the force that a motion without acceleration takes: dM/dt qd - dT/dq + dV/dq and friction.
 * With u = L^T qd: dM/dt qd = L (dL/dt^T qd) + dL/dt u, and dT/dq is the pull-back of qd u^T through dL/dq. */
static void motion(const real *restrict q, const real *restrict qd, real *restrict L, real *restrict bias)
{
    real L_rate[D * D], diagonal_slope[D], u[D], v[D], force[D];
${features}
    times_transposed(L, qd, u);
    pack_covector(diagonal_slope, qd, u, adjoint);
${pull_back}
    times_transposed(L_rate, qd, v);
    times(L, v, bias);
    for (int i = 0; i < D; ++i) {
        for (int j = 0; j <= i; ++j) bias[i] += L_rate[i * D + j] * u[j];
        bias[i] += force[i]${friction};
    }
}

void ${name}_inverse_dynamics(const real q[D], const real qd[D], const real qdd[D], real tau[D])
{
    real L[D * D], bias[D], v[D];
    motion(q, qd, L, bias);
    times_transposed(L, qdd, v);
    times(L, v, tau);
    for (int i = 0; i < D; ++i) tau[i] += bias[i];
}

void ${name}_forward_dynamics(const real q[D], const real qd[D], const real tau[D], real qdd[D])
{
    real L[D * D], bias[D], v[D];
    motion(q, qd, L, bias);
    for (int i = 0; i < D; ++i) bias[i] = tau[i] - bias[i];
    solve_lower(L, bias, v);
    solve_lower_transposed(L, v, qdd);
}

real ${name}_energy(const real q[D], const real qd[D])
{
    real L[D * D], u[D], energy = 0;
${values}
    times_transposed(L, qd, u);
    for (int i = 0; i < D; ++i) energy += u[i] * u[i];
    return energy / 2${potential};
}

void ${name}_mass_matrix(const real q[D], real M[D * D])
{
    real L[D * D];
${factor_values}
    for (int i = 0; i < D; ++i) times(L, &L[i * D], &M[i * D]);
}
"""
HAMILTONIAN = """
/* L with M^-1 = L L^T, and for u = L^-1 qd, p = L^-T u:
 * drift = dL/dt u, momentum_drift = dL/dt^T p, load = dT/dq + dV/dq and friction. */
static void motion(const real *restrict q, const real *restrict qd, real *restrict L, real *restrict drift,
                   real *restrict momentum_drift, real *restrict load)
{
    real L_rate[D * D], diagonal_slope[D], u[D], p[D], force[D];
${features}
    solve_lower(L, qd, u);
    solve_lower_transposed(L, u, p);
    times(L_rate, u, drift);
    times_transposed(L_rate, p, momentum_drift);
    for (int i = 0; i < D; ++i) u[i] = -u[i];
    pack_covector(diagonal_slope, p, u, adjoint);
${pull_back}
    for (int i = 0; i < D; ++i) load[i] = force[i]${friction};
}

void ${name}_inverse_dynamics(const real q[D], const real qd[D], const real qdd[D], real tau[D])
{
    real L[D * D], drift[D], momentum_drift[D], load[D], v[D];
    motion(q, qd, L, drift, momentum_drift, load);
    for (int i = 0; i < D; ++i) drift[i] = qdd[i] - drift[i];
    solve_lower(L, drift, v);
    for (int i = 0; i < D; ++i) v[i] -= momentum_drift[i];
    solve_lower_transposed(L, v, tau);
    for (int i = 0; i < D; ++i) tau[i] += load[i];
}

void ${name}_forward_dynamics(const real q[D], const real qd[D], const real tau[D], real qdd[D])
{
    real L[D * D], drift[D], momentum_drift[D], load[D], v[D];
    motion(q, qd, L, drift, momentum_drift, load);
    for (int i = 0; i < D; ++i) load[i] = tau[i] - load[i];
    times_transposed(L, load, v);
    for (int i = 0; i < D; ++i) v[i] += momentum_drift[i];
    times(L, v, qdd);
    for (int i = 0; i < D; ++i) qdd[i] += drift[i];
}

real ${name}_energy(const real q[D], const real qd[D])
{
    real L[D * D], u[D], energy = 0;
${values}
    solve_lower(L, qd, u);
    for (int i = 0; i < D; ++i) energy += u[i] * u[i];
    return energy / 2${potential};
}

void ${name}_mass_matrix(const real q[D], real M[D * D])
{
    real L[D * D], unit[D], v[D];
${factor_values}
    for (int i = 0; i < D; ++i) {
        for (int j = 0; j < D; ++j) unit[j] = i == j;
        solve_lower(L, unit, v);
        solve_lower_transposed(L, v, &M[i * D]);
    }
}
"""
