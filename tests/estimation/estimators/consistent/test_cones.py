import numpy as np
import pytest

from robotid.base.exceptions import NotConvergedError
from robotid.estimation.estimators.consistent.cones import (
    Cone,
    Subspace,
    _described,
    least_squares,
    svec,
    unsvec,
)
from robotid.robot.parameters import pseudo_inertia_basis


def matrices(rng, count):
    half = rng.standard_normal((count, 4, 4))
    return half @ half.transpose(0, 2, 1)


def cone_of(G, h, S=None, s=None):
    p = np.shape(G)[1]
    S = np.zeros((0, p)) if S is None else S
    s = np.zeros(0) if s is None else s
    rows = tuple(f"bound {k}" for k in range(len(h)))
    return Cone(
        np.array(G, float), np.array(h, float), S, s, (*rows, *(["psd 0"] * (len(s) // 10)))
    )


def psd_cone():
    """The possible bodies, margin 0.01."""
    S = svec(pseudo_inertia_basis()).T
    return cone_of(np.zeros((0, 10)), np.zeros(0), S, -svec(0.01 * np.eye(4)))


def test_svec_keeps_the_inner_product_and_can_be_undone(rng):
    A, B = matrices(rng, 2)
    assert svec(A) @ svec(B) == pytest.approx(np.trace(A @ B))
    many = matrices(rng, 3)
    np.testing.assert_allclose(unsvec(svec(many).reshape(-1)), many)


def test_a_subspace_holds_what_the_equalities_say(rng):
    E = np.array([[1.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    space = Subspace.of(E, np.array([6.0, 2.0, 2.0]))
    for y in rng.standard_normal((5, space.basis.shape[1])):
        np.testing.assert_allclose(E @ (space.origin + space.basis @ y), [6.0, 2.0, 2.0])
    assert space.basis.shape == (4, 2)
    np.testing.assert_allclose(space.basis.T @ space.basis, np.eye(2), atol=1e-14)


def test_bounds_bind_as_they_do_by_hand():
    # minimise (x - 3)^2 + (y - 1)^2 with x + y <= 2: (2, 0)
    cone = cone_of([[-1.0, -1.0]], [2.0])
    x = least_squares(np.eye(2), np.array([3.0, 1.0]), cone).x
    np.testing.assert_allclose(x, [2.0, 0.0], atol=1e-6)  # the solvers' own tolerance


def test_the_nearest_possible_body_has_no_negative_eigenvalue(rng):
    # in svec coordinates the nearest positive semidefinite matrix drops negative eigenvalues
    wanted = 0.5 * sum(matrices(rng, 2)) - 2.0 * np.eye(4)
    cone = psd_cone()
    values, vectors = np.linalg.eigh(wanted)
    nearest = (vectors * np.maximum(values, 0.01)) @ vectors.T
    A = np.linalg.qr(cone.S)[1]
    d = np.linalg.qr(cone.S)[0].T @ svec(wanted)
    x = least_squares(A, d, cone).x
    np.testing.assert_allclose(cone.matrices(x)[0] + 0.01 * np.eye(4), nearest, atol=1e-7)


def test_where_nothing_binds_the_answer_is_exact(rng):
    A = np.triu(rng.standard_normal((3, 3))) + 3 * np.eye(3)
    solution = least_squares(A, A @ np.ones(3), cone_of(np.eye(3), np.zeros(3)))
    np.testing.assert_allclose(solution.x, np.ones(3), rtol=1e-14)
    assert solution.message == "no constraint is active"


def test_bounds_without_a_point_are_named():
    cone = cone_of([[1.0], [-1.0]], [-2.0, 1.0])  # x >= 2 and x <= 1
    with pytest.raises(NotConvergedError, match=r"no parameters meet all constraints \(bound, "):
        least_squares(np.eye(1), np.zeros(1), cone)


def test_a_solver_that_stops_early_says_so():
    A, d = np.diag(10.0 ** np.arange(-5, 5)), -np.arange(1.0, 11.0)
    text = "Clarabel failed to solve the physically consistent fit with the constraints psd; "
    with pytest.raises(NotConvergedError, match=text) as caught:
        least_squares(A, d, psd_cone(), max_iterations=1)
    assert caught.value.status in ("MaxIterations", "AlmostSolved")


def test_active_constraints_are_tangent_to_the_boundary(rng):
    # a body of rank 2: any direction orthogonal to all gradients keeps its rank to second order
    cone = psd_cone()
    half = rng.standard_normal((4, 2))
    x = np.linalg.solve(cone.S, svec(half @ half.T) - cone.s)
    gradients, labels = cone.active(x, 1e-6)
    assert labels == ("psd 0",) * 3
    _, _, Vt = np.linalg.svd(gradients)
    step = Vt[3:].T @ rng.standard_normal(7)
    near, nearer = (np.linalg.eigvalsh(cone.matrices(x + t * step)[0])[:2] for t in (1e-3, 1e-4))
    assert np.abs(nearer).max() < 0.02 * np.abs(near).max()  # quadratic: 0.01


def test_a_linear_bound_is_active_at_its_face_only():
    cone = cone_of([[2.0, 0.0], [0.0, 1.0]], [-2.0, 0.0])
    gradients, labels = cone.active(np.array([1.0, 5.0]), 1e-6)
    np.testing.assert_allclose(gradients, [[2.0, 0.0]])
    assert labels == ("bound 0",)


def test_a_solver_that_breaks_down_is_a_fit_that_was_not_solved(monkeypatch):
    """Clarabel is written in Rust: what it panics with is no Exception."""

    class PanicException(BaseException):
        pass

    class Solver:
        def __init__(self, *_):
            pass

        def solve(self):
            raise error

    monkeypatch.setattr("clarabel.DefaultSolver", Solver)
    error = PanicException("eigenvalues of NaN")
    with pytest.raises(NotConvergedError, match="Clarabel failed to solve") as caught:
        least_squares(np.eye(10), np.ones(10), psd_cone())
    assert caught.value.status == "Panic"
    error = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        least_squares(np.eye(10), np.ones(10), psd_cone())


def test_the_message_states_each_solution_that_is_less_exact():
    solved, almost = "Solved", "AlmostSolved"
    assert _described([solved]) == "Solved"
    assert _described([solved, solved]) == "Solved, refined once"
    assert _described([almost, solved, solved]) == "first AlmostSolved, refined 2 times"
    last = "Solved, refined 2 times, the last one AlmostSolved"
    assert _described([solved, solved, almost]) == last
