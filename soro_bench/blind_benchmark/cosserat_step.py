"""What cables and damping do to the velocities of a Cosserat rod in one step, implicitly; compiled by Numba."""

import numpy as np
from numba import njit

from soro_bench.arrays import Floats, Ints

_SWEEPS, _SETTLED = 100, 1e-8  # of the cables' forces; N, change of a sweep


@njit(cache=True)
def settle(
    position: Floats, velocity: Floats, director: Floats, omega: Floats, tangent: Floats, inertia: Floats,
    turn: Floats, lightness: Floats, loss: Floats, dt: float, counts: Ints, node: Ints, element: Ints, offset: Floats,
    cables: Ints, rows: Floats, forces: Floats, lengths: Floats, rates: Floats,
) -> None:  # fmt: skip
    """Damp and pull ``velocity`` and ``omega``; also writes ``forces``, ``lengths`` and ``rates``.

    Args:
        position, velocity: (3, n + 1) m and m/s, of nodes.
        director, omega: (3, 3, n), (3, n) rad/s, of elements and in their frames.
        tangent: (3, n).
        inertia: (n,) kg m^2, across.
        turn: (n, n) angular velocities, in the world, after damping by angular momentum before it.
        lightness: (n + 1,) 1/kg; 0 of held nodes.
        loss: (n,) kg, axial damping of an element times the time step ``dt`` [s].
        counts, node, element, offset: of the cables' eyelets.
        cables: (m,) along which a force acts, which is clip(a + b length + c rate, low, high).
        rows: (m, 5) a [N], b [N/m], c [N s/m], low and high [N].
        forces: (m,) N; on entry a guess.
        lengths, rates: (8,) m, and m/s at the end.
    """
    n, number = inertia.shape[0], counts.shape[0]
    moved, turned = np.zeros((number, n + 1, 3)), np.zeros((number, n, 3))  # what a rate is of the velocities
    _measure(position, director, counts, node, element, offset, lengths, moved, turned)
    speed, spin = np.empty((n + 1, 3)), np.empty((n, 3))
    for i in range(n + 1):
        for d in range(3):
            speed[i, d] = velocity[d, i]
    for i in range(n):
        for d in range(3):
            spin[i, d] = inertia[i] * (
                director[0, d, i] * omega[0, i] + director[1, d, i] * omega[1, i] + director[2, d, i] * omega[2, i]
            )
    _damp(speed, tangent, lightness, loss)
    spin = turn @ spin
    shifts, spins = np.zeros((number, n + 1, 3)), np.zeros((number, n, 3))  # by an impulse along each cable
    for c in range(number):
        for i in range(n + 1):
            for d in range(3):
                shifts[c, i, d] = lightness[i] * moved[c, i, d]
        _damp(shifts[c], tangent, lightness, loss)
        spins[c] = turn @ turned[c]
    flat = moved.reshape((number, 3 * n + 3)), turned.reshape((number, 3 * n))
    compliance = flat[0] @ shifts.reshape((number, 3 * n + 3)).T + flat[1] @ spins.reshape((number, 3 * n)).T  # 1/kg
    free = flat[0] @ speed.ravel() + flat[1] @ spin.ravel()  # m/s, rates without forces
    total = _forces(cables, rows, forces, lengths, free, compliance, dt, rates)
    for c in range(number):
        speed -= dt * total[c] * shifts[c]
        spin -= dt * total[c] * spins[c]
    for i in range(n + 1):
        for d in range(3):
            velocity[d, i] = speed[i, d]
    for i in range(n):
        for d in range(3):
            omega[d, i] = (
                director[d, 0, i] * spin[i, 0] + director[d, 1, i] * spin[i, 1] + director[d, 2, i] * spin[i, 2]
            )


@njit(cache=True)
def _measure(
    position: Floats, director: Floats, counts: Ints, node: Ints, element: Ints, offset: Floats,
    lengths: Floats, moved: Floats, turned: Floats,
) -> None:  # fmt: skip
    """Lengths of the cables, and the Jacobians of their rates."""
    arm, before, here, unit = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for c in range(counts.shape[0]):
        lengths[c] = 0.0
        for i in range(counts[c]):
            _place(position, director, node[c, i], element[c, i], offset[c, i], here, arm)
            if i > 0:
                size = np.sqrt((here[0] - before[0]) ** 2 + (here[1] - before[1]) ** 2 + (here[2] - before[2]) ** 2)
                lengths[c] += size
                for d in range(3):
                    unit[d] = (here[d] - before[d]) / size
                _add(moved[c], turned[c], node[c, i], element[c, i], arm, unit, 1.0)
                _place(position, director, node[c, i - 1], element[c, i - 1], offset[c, i - 1], before, arm)
                _add(moved[c], turned[c], node[c, i - 1], element[c, i - 1], arm, unit, -1.0)
            before[:] = here


@njit(cache=True)
def _place(
    position: Floats, director: Floats, node: int, element: int, offset: Floats, here: Floats, arm: Floats
) -> None:
    """Write the place of an eyelet, and its arm from the node, in the world."""
    for d in range(3):
        arm[d] = 0.0
        for e in range(3):
            arm[d] += director[e, d, element] * offset[e]
        here[d] = position[d, node] + arm[d]


@njit(cache=True)
def _add(moved: Floats, turned: Floats, node: int, element: int, arm: Floats, unit: Floats, sign: float) -> None:
    """Add what an eyelet's motion along a unit vector is of the velocities."""
    for d in range(3):
        moved[node, d] += sign * unit[d]
        e, f = (d + 1) % 3, (d + 2) % 3
        turned[element, d] += sign * (arm[e] * unit[f] - arm[f] * unit[e])


@njit(cache=True)
def _damp(speed: Floats, tangent: Floats, lightness: Floats, loss: Floats) -> None:
    """Axial damping of the elements at the velocities that they end with: a tridiagonal system of impulses."""
    n = loss.shape[0]
    diagonal, upper, impulse = np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        diagonal[i] = 1 / loss[i] + lightness[i] + lightness[i + 1]
        impulse[i], upper[i] = 0.0, 0.0
        for d in range(3):
            impulse[i] += tangent[d, i] * (speed[i + 1, d] - speed[i, d])
            if i + 1 < n:
                upper[i] -= lightness[i + 1] * tangent[d, i] * tangent[d, i + 1]
    for i in range(1, n):
        factor = upper[i - 1] / diagonal[i - 1]
        diagonal[i] -= factor * upper[i - 1]
        impulse[i] -= factor * impulse[i - 1]
    for i in range(n - 1, -1, -1):
        if i + 1 < n:
            impulse[i] -= upper[i] * impulse[i + 1]
        impulse[i] /= diagonal[i]
    for i in range(n):
        for d in range(3):
            speed[i, d] += lightness[i] * tangent[d, i] * impulse[i]
            speed[i + 1, d] -= lightness[i + 1] * tangent[d, i] * impulse[i]


@njit(cache=True)
def _forces(
    cables: Ints,
    rows: Floats,
    forces: Floats,
    lengths: Floats,
    free: Floats,
    compliance: Floats,
    dt: float,
    rates: Floats,
) -> Floats:
    """(8,) N, of all rows of each cable; projected Gauss-Seidel."""
    total = np.zeros(free.shape[0])
    for r in range(cables.shape[0]):
        total[cables[r]] += forces[r]
    for _ in range(_SWEEPS):
        change = 0.0
        for r in range(cables.shape[0]):
            c = cables[r]
            rate = free[c]
            for d in range(free.shape[0]):
                rate -= dt * compliance[c, d] * total[d]
            share = dt * compliance[c, c]
            rate += share * forces[r]  # without this row's own
            wanted = (rows[r, 0] + rows[r, 1] * lengths[c] + rows[r, 2] * rate) / (1 + rows[r, 2] * share)
            new = min(max(wanted, rows[r, 3]), rows[r, 4])
            total[c] += new - forces[r]
            change = max(change, abs(new - forces[r]))
            forces[r] = new
        if change < _SETTLED:
            break
    for c in range(free.shape[0]):
        rates[c] = free[c]
        for d in range(free.shape[0]):
            rates[c] -= dt * compliance[c, d] * total[d]
    return total
