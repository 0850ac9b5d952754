"""Bristle deflections of presliding friction in closed-loop simulations, compiled by Numba.

Imported only for closed-loop simulations. The arguments are those of ``loop_lanes``. Each bristle
term has five entries: z, the z that acts within a step, and three derivatives.
"""

from robotid.dynamics.kernels.lanes import compiled, get, put, put3
from robotid.dynamics.kernels.vector_lanes import wide
from robotid.dynamics.simulation.law_lanes import deflection_by_lane, initial_deflection_by_lane
from robotid.robot.drive_term import BRISTLES

_MOVED_BEFORE = 0.1  # assumed time of motion before the simulation, for initial deflections [s]


@compiled
def presliding(work, n, at, terms, span):
    """Write the presliding friction after a time at the speeds u, and its derivative."""
    u, bristles, grip = at[2], at[13], at[14]
    codes, shapes, values, spans = terms
    for i in range(n):
        speed, f, f_u = get(work, u + i), wide(0.0), wide(0.0)
        for k in range(spans[i, 0], spans[i, 2]):
            if codes[k, 2] == BRISTLES:
                before = get(work, bristles + 5 * int(shapes[k, 3]))
                z, z_u, _ = deflection_by_lane(shapes[k], before, speed, span)
                f += values[k] * z
                f_u += values[k] * z_u
        put(work, grip + i, f)
        put(work, grip + n + i, f_u)


@compiled
def advance_bristles(work, n, at, terms, span, step):
    """Write z after a step, the acting z a time after its start, and derivatives of both.

    The derivatives are: of the acting z by z before; of z after by the speed u, and by z before.
    """
    u, bristles = at[2], at[13]
    codes, shapes, values, spans = terms
    for i in range(n):
        for k in range(spans[i, 0], spans[i, 2]):
            if codes[k, 2] == BRISTLES:
                z = bristles + 5 * int(shapes[k, 3])
                speed, before = get(work, u + i), get(work, z)
                acts, _, share = deflection_by_lane(shapes[k], before, speed, span)
                after, by_speed, by_before = deflection_by_lane(shapes[k], before, speed, step)
                put(work, z, after)
                put(work, z + 1, acts)
                put3(work, z + 2, (share, by_speed, by_before))


@compiled
def initialise_bristles(work, n, at, by_state, kinds, sums, terms, kind):
    """Write the initial z and its derivative by the initial speed v, columns of a ``kind``.

    It is that of steady sliding, unless the joint needs more than ``_MOVED_BEFORE`` for it.
    """
    v, bristles = at[1], at[13]
    codes, shapes, values, spans = terms
    for i in range(n):
        for k in range(spans[i, 0], spans[i, 2]):
            if codes[k, 2] != BRISTLES:
                continue
            slot, P = int(shapes[k, 3]), len(sums) - 1
            z, by_speed = initial_deflection_by_lane(shapes[k], get(work, v + i), _MOVED_BEFORE)
            put(work, bristles + 5 * slot, z)
            for p in range(P):
                if kinds[sums[p], 0] == kind and kinds[sums[p], 1] == i:
                    put(work, by_state + slot * P + p, by_speed)


@compiled
def bristle_column(work, n, at, sensitivities, terms, p, P, is_after):
    """Add the effect of bristle states to one column; after the step, advance their columns."""
    loss, bristles = at[11], at[13]
    own, change, by_state = sensitivities[3], sensitivities[4], sensitivities[6]
    codes, shapes, values, spans = terms
    for i in range(n):
        for k in range(spans[i, 0], spans[i, 2]):
            if codes[k, 2] != BRISTLES:
                continue
            slot = int(shapes[k, 3])
            z, Z = bristles + 5 * slot, by_state + slot * P + p
            x = get(work, Z)
            if is_after:
                x *= get(work, z + 4)
                put(work, Z, x + get(work, z + 3) * get(work, change + i))
            else:
                x *= values[k] * get(work, z + 2) / get(work, loss + i)
                put(work, own + i, get(work, own + i) + x)
